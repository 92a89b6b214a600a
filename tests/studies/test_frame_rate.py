"""The figures of ``study frames``, from frames whose times are known."""

from types import SimpleNamespace

import numpy as np
import pytest

import app
from rehearsal.pressed_organ import Step
from rehearsal.real_time.start_times import StartTimes
from render.viewer import Controls, Settings
from scenes.scene import EMBEDDED, load_scene
from sim.solver import StepSettings
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
    """A window that draws nothing, each frame in 50 ms."""

    def __init__(self, clock: list[float]) -> None:
        self.clock, self.running, self.layout = clock, True, SimpleNamespace(width=1280, height=720)

    def read_controls(self) -> Controls:
        return Controls(Settings())

    def draw(self, view: None) -> None:
        self.clock[0] += 0.05


@pytest.fixture
def hand(monkeypatch) -> ScriptedHand:
    clock = [1000.0]
    monkeypatch.setattr(frame_rate, "perf_counter", lambda: clock[0])
    monkeypatch.setattr("rehearsal.real_time.frame_times.perf_counter", lambda: clock[0])
    rehearsal = SimpleNamespace(
        manipulator=SimpleNamespace(home=np.eye(4)), size_mm=np.array([16.0, 9.0, 2 * HALF_LENGTH_MM])
    )
    return ScriptedHand(SimpleNamespace(rehearsal=rehearsal, viewer=Window(clock)), StartTimes(), 6.0)


def led(hand: ScriptedHand) -> list[Controls]:
    """The controls of all frames, each with three steps of 1/60 s at four fifths of the pace, 80 ms after their input."""
    given = []
    while hand.running:
        given.append(hand.read_controls())
        hand.draw(None)
        times, now = getattr(hand.frames, "times", None), hand.window.clock[0]
        if times is not None:
            times.stages_ms["drawing"].append(50.0)
            times.steps += [Step(np.eye(4), 1 / 75, 4, 9.0, late_ms=late) for late in (0.0, 1.0, 8.0)]
            times.end_frame(simulated_s=0.8 * (now - 1000.0), input_s=now - 0.08)
    return given


def test_the_hand_presses_and_drags_over_the_organ(hand):
    given = led(hand)
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


def test_the_figures_are_those_of_the_frames_after_the_first_seconds(hand, tmp_path):
    led(hand)
    scene = load_scene(EMBEDDED)
    rehearsal = SimpleNamespace(settings=StepSettings(iterations=4, substeps=1), scene=scene)
    run = SimpleNamespace(rehearsal=rehearsal, arch="cpu", start=hand.start)
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


def test_shares_are_of_the_simulated_time():
    steps = [Step(np.eye(4), length, 4, 1.0) for length in (1 / 60, 1 / 60, 1 / 30)]
    assert lengths_of(steps) == {"1/60": 0.5, "1/30": 0.5}
    assert spread_of([]) == {} and spread_of(range(101)) == dict(median=50.0, p95=95.0, max=100.0)


def test_without_a_display_it_is_refused_in_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(frame_rate, "display_available", lambda: False)
    assert app.main(["study", "frames", "--out", str(tmp_path / "out")]) == 2
    assert "needs a display" in capsys.readouterr().err and not (tmp_path / "out").exists()
