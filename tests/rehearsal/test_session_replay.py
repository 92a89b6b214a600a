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

import app
from rehearsal import headless, run
from rehearsal.build_solver import step_settings
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.input_files import InputFiles
from rehearsal.live_settings import DEFAULT_KEYS, LiveSettings, initial_settings
from rehearsal.loop import timeline
from rehearsal.loop.command import Move, NewSession, SetValues
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.packed_arrays import pack_seen
from rehearsal.sessions.replay import Replay, open_session
from rehearsal.sessions.session_file import Header, Log, SessionError, makes_state, read_log
from rehearsal.tracking.pose_file import TimedPoses
from rehearsal.window_loop import PREPARING
from render.viewer import Controls, View
from render.window import NoVulkan
from scenes.anatomy import LoadedAnatomy
from settings import with_values
from sim.device import start
from ultrasound import coverage
from ultrasound.probe_manipulator import ManipulatorState
from version import VERSION


class Watched(NullViewer):
    """A window that draws nothing. ``seen`` is what each view of its frames shows."""

    def __init__(self, settings: LiveSettings, script: Any) -> None:
        super().__init__(settings, script)
        self.seen: list[tuple] = []
        self.now_s = 0.0

    def read_controls(self) -> Controls:
        # A frame for each step.
        self.now_s += 1 / 60
        return super().read_controls()

    def draw(self, view: View) -> None:
        super().draw(view)
        if view.status != PREPARING:
            images = (image.tobytes() for image in view.images.values())
            self.seen.append((view.transducer_pose.tobytes(), *images))


def is_part_of(shown: list[tuple], seen: list[tuple]) -> bool:
    """Whether all that was shown was seen before, in the same order."""
    rest = iter(seen)
    return all(view in rest for view in shown)


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
    scene, organ = rehearsal.case.scene, rehearsal.organ
    rehearsal.reset()
    organ.settings = step_settings(scene.tissue, scene.solver)
    organ.set(scene.tissue, scene.solver, scene.gravity)
    rehearsal.manipulator.state = ManipulatorState()
    rehearsal.do(NewSession(pose=rehearsal.manipulator.pose()))
    return rehearsal


def files_of(rehearsal: Rehearsal, **named: Any) -> InputFiles:
    return InputFiles(Path(), rehearsal.case.scene, rehearsal.case.probe, DEFAULT_KEYS, **named)


def run_of(
    rehearsal: Rehearsal, loaded: LoadedAnatomy, asked: RehearseOptions, files: InputFiles, viewer=None
):
    """A run whose steps are made in this process."""
    model = rehearsal.organ.model
    shown = rehearsal.anatomy, rehearsal.timeline, rehearsal.manipulator
    built = run.Built(*shown, model.counts(), model.serial, rehearsal)
    return run.RehearsalRun(built, loaded, "cpu", asked, files, viewer)


def rehearsed(built, monkeypatch, out: Path, script: Any, log: Log | None = None, at_s: float = 0.0):
    """What a rehearsal showed, frame by frame, the tissue's digest at its end, and what it recorded."""
    rehearsal, loaded = rewound(built[0]), built[1]
    settings = initial_settings(rehearsal.case)
    viewer = Watched(settings, script(settings))
    monkeypatch.setattr("rehearsal.window_loop.perf_counter", lambda: viewer.now_s)
    asked, files = RehearseOptions(out=out, at=at_s), files_of(rehearsal, log=log)
    each = run_of(rehearsal, loaded, asked, files, viewer)
    each.in_window()
    recorder = each.recording.recorder
    return viewer.seen, rehearsal.organ.digest(), recorder and read_log(recorder.path)


def user(settings: LiveSettings, frames: int = 150) -> Iterator[Controls]:
    """All there is to do, in 140 moments and ten frozen frames."""
    for frame in range(frames):
        values = {
            "tissue.young_kpa": 40.0 if 30 <= frame < 50 else 15.0,
            "solver.iterations": 3 if 40 <= frame < 60 else 8,
            "probe.gain_percent": 40.0 if frame < 85 else 75.0,
            "probe.depth_mm": 20.0 if 60 <= frame < 108 else 40.0,
        }
        over = np.array([0.1 * (frame % 100) - 5.0, -80.0, 3.0]), np.array([0.0, 1.0, 0.0])
        keys = dict(undo=frame in (70, 71, 140), redo=frame == 72, bookmark=frame in (20, 98))
        keys |= dict(to_bookmark=frame in (110, 112), reset=frame == 130, freeze=frame in (80, 90))
        at = over if frame % 40 < 30 else None
        tilt_deg = 0.5 * (frame % 7 == 0)
        yield Controls(
            with_values(settings, values),
            at,
            press=frame % 40 > 15,
            tilt_deg=tilt_deg,
            quit=frame == frames - 1,
            **keys,
        )


def watching(frames: int, take_over_at: int = -1) -> Any:
    def script(settings: LiveSettings) -> Iterator[Controls]:
        for frame in range(frames):
            press = 0 <= take_over_at < frame
            news = "Gamepad ready" if frame == 0 else ""
            last = frame == frames - 1
            yield Controls(None, take_over=frame == take_over_at, press=press, quit=last, message=news)

    return script


def test_a_rehearsal_is_replayed_to_the_bit_and_the_pixel(built, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(timeline, "CHECKPOINT_S", 1.0)
    summaries: list[dict] = []
    monkeypatch.setattr(run, "summary_text", lambda summary: summaries.append(summary) or "")
    seen, end, log = rehearsed(built, monkeypatch, tmp_path, user)
    assert len(seen) == 150 and len(set(seen)) > 120 and log.summary["went_back"] == 7
    values = [command.values for _, command in log.commands if isinstance(command, SetValues)]
    assert len({each["solver.iterations"] for each in values if "solver.iterations" in each}) > 1
    assert log.steps == 140 - 7 - 2
    for at_s in (0.0, 1.8):
        rest = sum(makes_state(command) for _, command in log.commands[log.place_at(at_s) :])
        shown, again, _ = rehearsed(built, monkeypatch, tmp_path, watching(rest), log, at_s)
        assert len(shown) == rest and is_part_of(shown, seen) and again == end
        verdict = f"compared, to {log.length_s:.1f} s; state {end}"
        told = capsys.readouterr().out
        assert "identical in all" in told and verdict in told
    assert summaries == [log.summary] * 3 and log.summary["bookmarks"] == 2
    opened_at_each(built, log, capsys)


def opened_at(built, log: Log, at_s: float) -> tuple[LiveMeasurements, Replay]:
    """The measurements of a session that was opened at a time."""
    rehearsal = rewound(built[0])
    settings, replay = initial_settings(rehearsal.case), Replay(log)
    instruments = LiveMeasurements(rehearsal.anatomy, rehearsal.manipulator)
    given = rehearsal.timeline, rehearsal.anatomy, settings, instruments, [instruments]
    open_session(replay, at_s, *given)
    return instruments, replay


def opened_at_each(built, log: Log, capsys) -> None:
    """Wherever a session is opened, the read-outs are those that it noted there."""
    ends_s, after = log.ends_s, {}
    for place, (number, command) in enumerate(log.commands[:-1]):
        if isinstance(command, Move) and isinstance(log.commands[place + 1][1], Move):
            after[number + 1] = float(ends_s[place])
    noted = [number for number in sorted(log.readings) if number in after and number > 20]
    assert len(noted) >= 6
    for number in noted[::2]:
        instruments, replay = opened_at(built, log, after[number])
        assert instruments.figures() == log.readings[number], number
        assert instruments.course.duration_s == pytest.approx(after[number])
        assert replay.log.commands[replay.place][0] == number
    capsys.readouterr()
    at_s = max(time_s for time_s in after.values() if time_s < 2.1)
    bare, _ = opened_at(built, replace(log, seen={}), at_s)
    assert "no record of the coverage until" in capsys.readouterr().out
    whole, _ = opened_at(built, log, at_s)
    assert bare.figures()["seen_organ"] < whole.figures()["seen_organ"]
    other = replace(log, seen=dict.fromkeys(log.seen, pack_seen(np.zeros((2, 3, 4), bool))))
    with pytest.raises(SessionError, match=r"coverage of \(2, 3, 4\) voxels, expected \([^\n]*$"):
        opened_at(built, other, at_s)


def test_a_session_that_goes_on_from_a_replay_is_one_too(built, monkeypatch, tmp_path, capsys):
    summaries: list[dict] = []
    monkeypatch.setattr(run, "summary_text", lambda summary: summaries.append(summary) or "")
    _, _, first = rehearsed(built, monkeypatch, tmp_path, partial(user, frames=60))
    seen, end, second = rehearsed(built, monkeypatch, tmp_path, watching(60, 20), first, 0.5)
    assert second.steps == 40 and second.header.begins and second.header.version == VERSION
    assert "recorded by version" not in capsys.readouterr().out
    second.header.version = "0.9"
    shown, again, _ = rehearsed(built, monkeypatch, tmp_path, watching(40), second)
    told = capsys.readouterr().out
    assert is_part_of(shown, seen[20:]) and again == end and summaries[2] == summaries[1] == second.summary
    assert second.summary["duration_s"] == round(40 / 60, 3) and summaries[0] == first.summary
    assert told.count("Gamepad ready") == 1 and f"recorded by version 0.9, replayed by {VERSION}" in told


def test_a_tracked_file_is_followed_headless_and_replayed(built, monkeypatch, tmp_path, capsys):
    rehearsal, loaded = rewound(built[0]), built[1]
    case, manipulator = rehearsal.case, rehearsal.manipulator
    monkeypatch.setattr(headless, "open_viewer", no_vulkan)
    poses = [case.probe_in_patient(rehearsal.frame.pose)]
    for _ in range(30):
        manipulator.slide(0.3, -0.1)
        poses.append(case.probe_in_patient(manipulator.pose()))
    rewound(rehearsal)
    # The slides, 9.5 mm, in half a second.
    track = TimedPoses(
        np.linspace(2.0, 2.5, 31), [None if 8 <= k < 12 else pose for k, pose in enumerate(poses)]
    )
    tracked = run_of(rehearsal, loaded, RehearseOptions(out=tmp_path), files_of(rehearsal, track=track))
    tracked.headless()
    log = read_log(tracked.recording.recorder.path)
    assert log.steps == 31 and case.probe_in_patient(rehearsal.frame.pose) == pytest.approx(poses[-1])
    assert "B-mode at detail level" in capsys.readouterr().out and (tmp_path / "slices").is_dir()
    rewound(rehearsal)
    (tmp_path / "bare").mkdir()
    asked = RehearseOptions(out=tmp_path / "bare", no_pictures=True)
    run_of(rehearsal, loaded, asked, files_of(rehearsal, log=log)).headless()
    told = capsys.readouterr().out
    assert "replay    identical" in told or log.digests == {}
    assert "no images" in told and "per image" not in told
    assert sorted(path.name for path in (tmp_path / "bare").iterdir()) == FILES


@pytest.mark.parametrize(("seconds", "steps"), [(None, 15), (0.4, 6), (0.02, 1), (9.0, 15)])
def test_seconds_of_a_replay_are_counted_from_where_it_starts_in_the_recorded_lengths(seconds, steps):
    header = Header(anatomy="", scene={}, probe={}, arch="cpu", time_step_s=1 / 60)
    log = Log(header, [(number, Move(pose=np.eye(4), length_s=1 / 15)) for number in range(20)])
    replay = Replay(log)
    replay.place = 5
    asked = SimpleNamespace(options=RehearseOptions(seconds=seconds))
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
