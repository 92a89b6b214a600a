"""A real rehearsal recorded in a window that draws nothing, and replayed: the same bits and pixels."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from coarse_patient import coarse_patient
from null_viewer import NullViewer
from one_step_solver import OneStepSolver
from rehearsal.coordinates import probe_in_patient
from rehearsal.frame import WindowFrames
from rehearsal.open_window import initial_settings
from rehearsal.sessions.open_session import open_session

import app
from rehearsal import headless, run
from rehearsal.asked_files import AskedFiles
from rehearsal.build_solver import step_settings
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions import recorder
from rehearsal.sessions.packed_arrays import pack_seen
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import Header, Log, SessionError, read_log
from rehearsal.tracking.pose_file import TimedPoses
from render.keys import Keys
from render.viewer import Controls, Settings, View
from render.window import NoVulkan
from scenes.anatomy import LoadedAnatomy
from sim.device import start
from ultrasound import coverage
from version import VERSION


class Watched(NullViewer):
    """A window that draws nothing. ``seen`` is what each view of its frames shows, but for frozen ones."""

    def __init__(self, settings: Settings, script: Any) -> None:
        super().__init__(settings, script)
        self.seen: list[tuple] = []
        self.now_s = 0.0

    def read_controls(self) -> Controls:
        # A frame for each step.
        self.now_s += 1 / 60
        return super().read_controls()

    def watch(self, frames: WindowFrames) -> None:
        next_view = frames.next_view

        def watched(controls: Controls) -> View:
            view = next_view(controls)
            if not frames.frozen:
                images = (image.tobytes() for image in view.images.values())
                self.seen.append((view.transducer_pose.tobytes(), *images))
            return view

        frames.next_view = watched


def once(make: Any) -> Any:
    """Gives again what was made of the same arrays and numbers."""
    made: dict[tuple, Any] = {}

    def again(*given: Any) -> Any:
        call = tuple(np.asarray(each).tobytes() for each in given)
        return made[call] if call in made else made.setdefault(call, make(*given))

    return again


@pytest.fixture(scope="module")
def built() -> Iterator[tuple[Rehearsal, LoadedAnatomy]]:
    start("cpu")
    with pytest.MonkeyPatch.context() as patch:
        # Every run begins with a new coverage of the one organ.
        patch.setattr(coverage, "distance_grid", once(coverage.distance_grid))
        yield coarse_patient()


def rewound(rehearsal: Rehearsal) -> Rehearsal:
    """As it was built."""
    scene = rehearsal.scene
    rehearsal.reset()
    rehearsal.settings = step_settings(scene.tissue, scene.solver)
    rehearsal.set_gravity(scene.gravity.acceleration_m_s2)
    rehearsal.set_young(scene.tissue.young_kpa)
    return rehearsal


def files_of(rehearsal: Rehearsal, **named: Any) -> AskedFiles:
    return AskedFiles(Path(), rehearsal.scene, rehearsal.probe, Keys(), **named)


def rehearsed(built, monkeypatch, out: Path, script: Any, log: Log | None = None, at_s: float = 0.0):
    """What a rehearsal showed, frame by frame, the tissue's digest at its end, and what it recorded."""
    rehearsal, anatomy = rewound(built[0]), built[1]
    settings = initial_settings(rehearsal)
    viewer = Watched(settings, script(settings))
    monkeypatch.setattr("rehearsal.frame.perf_counter", lambda: viewer.now_s)
    asked, files = RehearseOptions(out=out, at=at_s), files_of(rehearsal, log=log)
    each = run.RehearsalRun(rehearsal, anatomy, "cpu", asked, files, viewer, OneStepSolver(rehearsal))
    each.in_window(prepare=viewer.watch)
    return viewer.seen, rehearsal.digest(), each.recorder and read_log(each.recorder.path)


def user(settings: Settings, frames: int = 150) -> Iterator[Controls]:
    """All there is to do, in 140 moments and ten frozen frames."""
    for frame in range(frames):
        settings.young_kpa = 40.0 if 30 <= frame < 50 else 15.0
        settings.iterations = 3 if 40 <= frame < 60 else 8
        settings.gain_percent = 40 if frame < 85 else 75
        settings.depth_mm = 20 if 60 <= frame < 108 else 40
        over = np.array([0.1 * (frame % 100) - 5.0, -80.0, 3.0]), np.array([0.0, 1.0, 0.0])
        keys = dict(undo=frame in (70, 71, 140), redo=frame == 72, bookmark=frame in (20, 98))
        keys |= dict(to_bookmark=frame in (110, 112), reset=frame == 130, freeze=frame in (80, 90))
        at = over if frame % 40 < 30 else None
        tilt_deg = 0.5 * (frame % 7 == 0)
        yield Controls(
            settings, at, press=frame % 40 > 15, tilt_deg=tilt_deg, quit=frame == frames - 1, **keys
        )


def watching(frames: int, take_over_at: int = -1) -> Any:
    def script(settings: Settings) -> Iterator[Controls]:
        for frame in range(frames):
            press = 0 <= take_over_at < frame
            news = "Gamepad ready" if frame == 0 else ""
            last = frame == frames - 1
            yield Controls(settings, take_over=frame == take_over_at, press=press, quit=last, message=news)

    return script


def test_a_rehearsal_is_replayed_to_the_bit_and_the_pixel(built, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(recorder, "STATE_S", 1.0)
    summaries: list[dict] = []
    monkeypatch.setattr(run, "summary_text", lambda summary: summaries.append(summary) or "")
    seen, end, log = rehearsed(built, monkeypatch, tmp_path, user)
    assert len(seen) == len(log.poses) == 140 and len(set(seen)) > 120 and log.summary["went_back"] == 7
    told = [event.value for events in log.events.values() for event in events if event.kind == "solver"]
    assert len({values["iterations"] for values in told if "iterations" in values}) > 2
    for at in (0, 125):
        shown, again, _ = rehearsed(built, monkeypatch, tmp_path, watching(140 - at), log, at / 60)
        assert shown == seen[at:] and again == end and "identical in all" in capsys.readouterr().out
    assert summaries == [log.summary] * 3 and log.summary["bookmarks"] == 2
    opened_at_each(built, log, capsys)


def opened_at_each(built, log: Log, capsys) -> None:
    """Wherever a session is opened, the read-outs are those that it noted there."""
    noted = {
        moment: event.value
        for moment, events in sorted(log.events.items())
        for event in events
        if event.kind == "reading"
    }
    # From the beginning; from a bookmark, over a change of depth and two ways back; on a state, and from there over a way back.
    for begins, moment in ((0, 30), (88, 105), (120, 120), (120, 135)):
        rehearsal, settings = rewound(built[0]), initial_settings(built[0])
        instruments = LiveMeasurements(rehearsal)
        assert Replay(rehearsal, log).begin_at(moment / 60) == begins
        replay = open_session(log, moment / 60, rewound(rehearsal), settings, instruments)
        assert replay.session.step_index == moment and instruments.figures() == noted[moment], moment
        assert instruments.course.duration_s == pytest.approx(moment / 60)
        assert settings.depth_mm == 40 and replay.bookmarks == 1 + (moment > 88)
    assert "Mind" not in capsys.readouterr().out
    instruments = LiveMeasurements(rehearsal)
    open_session(replace(log, seen={}), 127 / 60, rehearsal, initial_settings(rehearsal), instruments)
    assert "no record of the coverage until 2 s" in capsys.readouterr().out
    assert instruments.figures()["seen_organ"] < noted[120]["seen_organ"]
    assert instruments.course.duration_s == pytest.approx(7 / 60)
    other = replace(log, seen=dict.fromkeys(log.seen, pack_seen(np.zeros((2, 3, 4), bool))))
    with pytest.raises(SessionError, match=r"coverage of \(2, 3, 4\) voxels, expected \([^\n]*$"):
        open_session(other, 127 / 60, rehearsal, initial_settings(rehearsal), LiveMeasurements(rehearsal))


def test_a_session_that_goes_on_from_a_replay_is_one_too(built, monkeypatch, tmp_path, capsys):
    summaries: list[dict] = []
    monkeypatch.setattr(run, "summary_text", lambda summary: summaries.append(summary) or "")
    _, _, first = rehearsed(built, monkeypatch, tmp_path, partial(user, frames=60))
    led, end, second = rehearsed(built, monkeypatch, tmp_path, watching(60, 20), first, 0.5)
    assert len(second.poses) == 40 and second.header.begins and second.header.version == VERSION
    assert "recorded by version" not in capsys.readouterr().out
    second.header.version = "0.9"
    shown, again, _ = rehearsed(built, monkeypatch, tmp_path, watching(40), second)
    told = capsys.readouterr().out
    assert shown == led[20:] and again == end and summaries[2] == summaries[1] == second.summary
    assert second.summary["duration_s"] == round(40 / 60, 3) and summaries[0] == first.summary
    assert "identical in all 1 states" in told
    assert told.count("Gamepad ready") == 1 and f"recorded by version 0.9, replayed by {VERSION}" in told


def test_a_tracked_file_is_followed_headless_and_replayed(built, monkeypatch, tmp_path, capsys):
    rehearsal, anatomy = built
    rehearsal.reset()
    monkeypatch.setattr(headless, "open_viewer", no_vulkan)
    poses = [probe_in_patient(rehearsal)]
    for _ in range(30):
        rehearsal.manipulator.slide(0.3, -0.1)
        rehearsal.pose = rehearsal.manipulator.pose()
        poses.append(probe_in_patient(rehearsal))
    rehearsal.reset()
    # The slides, 9.5 mm, in half a second.
    track = TimedPoses(
        np.linspace(2.0, 2.5, 31), [None if 8 <= k < 12 else pose for k, pose in enumerate(poses)]
    )
    files = files_of(rehearsal, track=track)
    tracked = run.RehearsalRun(rehearsal, anatomy, "cpu", RehearseOptions(out=tmp_path), files)
    tracked.headless()
    log = read_log(tracked.recorder.path)
    assert len(log.poses) == 31 and probe_in_patient(rehearsal) == pytest.approx(poses[-1])
    told = [event.value for events in log.events.values() for event in events if event.kind == "solver"]
    assert len({values["iterations"] for values in told if "iterations" in values}) == 1
    assert "B-mode at detail level" in capsys.readouterr().out and (tmp_path / "slices").is_dir()
    rehearsal.reset()
    (tmp_path / "bare").mkdir()
    asked = RehearseOptions(out=tmp_path / "bare", no_pictures=True)
    run.RehearsalRun(rehearsal, anatomy, "cpu", asked, files_of(rehearsal, log=log)).headless()
    told = capsys.readouterr().out
    assert "identical in all 1 states" in told and "no images" in told and "per image" not in told
    assert sorted(path.name for path in (tmp_path / "bare").iterdir()) == FILES


@pytest.mark.parametrize(("seconds", "steps"), [(None, 15), (0.4, 6), (0.02, 1), (9.0, 15)])
def test_seconds_of_a_replay_are_counted_from_where_it_starts_in_the_recorded_lengths(seconds, steps):
    header = Header(anatomy="", scene={}, probe={}, arch="cpu", time_step_s=1 / 60)
    log = Log(header, np.zeros((20, 4, 4)), np.full(20, 1 / 15))
    replay = SimpleNamespace(log=log, session=SimpleNamespace(step_index=5), time_s=5 / 15)
    asked = SimpleNamespace(asked=RehearseOptions(seconds=seconds))
    assert run.RehearsalRun._replayed_steps(asked, replay) == steps


FILES = ["organ.ply", "report.json", "tumour.ply"]


def no_vulkan(rehearsal: Rehearsal, visible: bool) -> None:
    raise NoVulkan("none")


def test_a_session_is_replayed_in_parallel_or_on_one_core_as_it_was_recorded(tmp_path, monkeypatch, capsys):
    """Recorded on a machine with many cores, whose steps have other bits than those on one core."""
    short = ["--headless", "--no-pictures", "--cell", "7", "--arch", "cpu"]
    with monkeypatch.context() as patch:
        patch.setattr("sim.neo_hookean.is_too_small", lambda *given: False)
        assert app.main(["rehearse", *short, "--seconds", "2.1", "--out", str(tmp_path)]) == 0
    session = tmp_path / "session-001.jsonl"
    assert '"serial":false' in session.read_text("utf-8").splitlines()[0]
    other = tmp_path / "session-002.jsonl"
    other.write_text(session.read_text("utf-8").replace('"serial":false', '"serial":true', 1), "utf-8")
    verdicts = []
    for path in (session, other):
        capsys.readouterr()
        out = str(tmp_path / path.stem)
        assert app.main(["rehearse", *short[:2], "--replay", str(path), "--arch", "cpu", "--out", out]) == 0
        verdicts += [line for line in capsys.readouterr().out.splitlines() if line.startswith("replay ")]
    assert "identical in all 3 states" in verdicts[0] and "differs" in verdicts[1]
