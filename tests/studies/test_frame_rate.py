"""The figures of ``study frames``, from frames whose times are known."""

from types import SimpleNamespace

import numpy as np
import pytest
from settings_at_start import settings_with
from study_runs import refusal

from rehearsal.loop.frame import Step
from rehearsal.real_time.frame_times import FrameTimes
from rehearsal.real_time.start_times import StartTimes
from render.viewer import Controls
from scenes.scene import EMBEDDED, load_scene
from studies.performance import frame_rate
from studies.performance.frame_rate import (
    BEGIN_S,
    DRAG_MM,
    FROM_MM,
    FrameOptions,
    ScriptedHand,
    figures_of,
    lengths_of,
    spread_of,
    summary,
)

HALF_LENGTH_MM = 3.0


class Window:
    """A window that draws nothing."""

    running, layout = True, SimpleNamespace(width=1280, height=720)
    settings = settings_with()

    def quit(self) -> None:
        self.running = False


class User:
    """A source that gives the controls themselves."""

    status = "of the user"

    def commands(self, frame: None, controls: Controls, elapsed_s: float) -> list[Controls]:
        return [controls]


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr(frame_rate, "perf_counter", lambda: now[0])
    monkeypatch.setattr("rehearsal.real_time.frame_times.perf_counter", lambda: now[0])
    return now


@pytest.fixture
def hand(clock) -> ScriptedHand:
    case = SimpleNamespace(size_mm=np.array([16.0, 9.0, 2 * HALF_LENGTH_MM]), scene=load_scene(EMBEDDED))
    shown = dict(window=Window(), source=User(), anatomy=SimpleNamespace(case=case), times=FrameTimes())
    return ScriptedHand(SimpleNamespace(**shown), np.eye(4), StartTimes(), 6.0)


def led(hand: ScriptedHand, clock: list[float], most: int = 1000) -> list[Controls]:
    """The controls of all frames, or at most so many.

    Each frame takes 50 ms, and has three steps of 1/75 s at four fifths of the pace, 80 ms after their input.
    """
    given = []
    while hand.loop.window.running and len(given) < most:
        given += hand.commands(None, Controls(settings_with()), 0.05)
        clock[0] += 0.05
        times = hand.loop.times
        times.stages_ms["drawing"].append(50.0)
        times.steps += [step_of(1 / 75, late_ms) for late_ms in (0.0, 1.0, 8.0)]
        times.end_frame(simulated_s=0.8 * (clock[0] - 1000.0), input_s=clock[0] - 0.08)
    return given


def step_of(length_s: float, late_ms: float = 0.0) -> Step:
    return Step(0, np.eye(4), np.eye(4), length_s, 4, took_ms=9.0, late_ms=late_ms)


def test_the_hand_presses_and_drags_over_the_organ(hand, clock):
    given = led(hand, clock)
    # The first frame ends after 50 ms, where the script begins.
    assert len(given) == pytest.approx((BEGIN_S + 6.0) / 0.05, abs=3)
    places = np.array([controls.ray[0] for controls in given])
    assert np.abs(places[:, 0]).max() == pytest.approx(DRAG_MM, rel=0.01) and np.ptp(places[:, 1]) == 0
    assert places[:, 2] == pytest.approx(FROM_MM - HALF_LENGTH_MM)
    presses = np.array([controls.press for controls in given])
    # In 8 s, three presses of 1.8 s.
    assert presses.mean() == pytest.approx(5.4 / 8.0, abs=0.02) and np.diff(presses.astype(int)).sum() in (
        -1,
        0,
    )


def test_the_figures_are_those_of_the_frames_after_the_first_seconds(hand, clock, tmp_path):
    led(hand, clock)
    run = SimpleNamespace(anatomy=hand.loop.anatomy, arch="cpu", start=hand.start)
    figures = figures_of(run, hand, FrameOptions(out=tmp_path))
    assert figures["frames_per_s"] == pytest.approx(20.0) and figures["real_time_factor"] == pytest.approx(
        0.8
    )
    assert figures["latency_ms"] == dict(median=80.0, p95=80.0, max=80.0)
    assert figures["steps_per_s"] == 75.0 and figures["step_lengths_s"] == {"1/75": 1.0}
    assert figures["step_late_ms"]["max"] == 8.0 and figures["window"] == [1280, 720]
    assert figures["seconds"] == pytest.approx(6.0, abs=0.1) and figures["start_s"] > 0
    assert figures["memory_mb"][0] > 10 and figures["processor_s_per_s"] >= 0
    assert "20.0 a second in a window of 1280 x 720" in summary(figures)


def test_a_window_that_the_user_closes_has_figures_until_then(hand, clock, monkeypatch):
    # A processor without a pause.
    def times(process: object) -> SimpleNamespace:
        return SimpleNamespace(user=clock[0], system=0.0)

    monkeypatch.setattr(frame_rate.psutil.Process, "cpu_times", times)
    led(hand, clock, most=80)
    assert hand.loop.window.running and hand.load == 0.0 and hand.status == "of the user"
    hand.end()
    load = hand.load
    clock[0] += 60.0
    hand.end()
    assert not hand.loop.window.running and hand.load == load >= 0.9
    assert len(hand.times.ends_s) == pytest.approx((80 * 0.05 - BEGIN_S) / 0.05, abs=3)


def test_shares_are_of_the_simulated_time():
    steps = [step_of(length_s) for length_s in (1 / 60, 1 / 60, 1 / 30)]
    assert lengths_of(steps) == {"1/60": 0.5, "1/30": 0.5}
    assert spread_of([]) == {} and spread_of(range(101)) == dict(median=50.0, p95=95.0, max=100.0)


def test_without_a_display_it_is_refused_in_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(frame_rate, "display_available", lambda: False)
    line = refusal(capsys, "study", "frames", "--out", tmp_path / "out")
    assert "needs a display" in line and not (tmp_path / "out").exists()
