"""A tracked probe as input: the transducer follows, stays and waits; pose files; reproducibility."""

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import rotation_about
from rehearsal.coordinates import probe_in_patient
from rehearsal.inputs.input_source import ReplayInput
from rehearsal.inputs.user_input import UserInput
from rehearsal.sessions.session import Session
from rehearsal.tracking.tracked_probe import TrackEnded, has_moved, played_pose
from test_session import header
from test_undo_history import STEP_S, Numbers, ray, shown, step

import app
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session_file import read_log
from rehearsal.tracking.pose_file import PoseError, TimedPoses
from rehearsal.tracking.track_file import check_near, load_track
from render.viewer import Controls, Settings
from ultrasound.probe_manipulator import image_plane
from ultrasound.sweep import Sweep, SweepError, transform_fields
from ultrasound.sweep_file import write_sweep

LENGTH = 6.0


class Patient(Numbers):
    """Numbers that lie in a patient, off the middle of the CT."""

    origin = np.array([40.0, -7.0, 300.0])
    size_mm = np.array([16.0, 9.0, LENGTH])

    def image_plane(self) -> Any:
        return image_plane(self.pose, LENGTH, 10.0, 10.0)


class Tracker:
    """Gives what was set last."""

    def __init__(self, pose: np.ndarray | None) -> None:
        self.now = pose

    def pose(self) -> np.ndarray | None:
        return self.now


def placed(x: float, y: float = 0.0, tilt_deg: float = 0.0) -> np.ndarray:
    """A probe 20 mm over the middle of the ball, looking down, beside it by so much: in PLUS's axes, in the patient."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_about([1, 0, 0], tilt_deg - 90.0)
    pose[:3, 3] = Patient.origin + [x, y, 20.0]
    return pose


def live_of(tracker: Any) -> UserInput:
    return UserInput(Session(Patient()), tracked=tracker.pose)


def at(live: UserInput) -> np.ndarray:
    return probe_in_patient(live.session.rehearsal)


def steps(live: UserInput, count: int, **did: Any) -> np.ndarray:
    for _ in range(count):
        step(live, **did)
    return at(live)


@pytest.mark.parametrize("name", ["a.igs.mhd", "a.igs.nhdr"])
def test_a_sweep_of_two_files_is_refused_with_what_is_read(tmp_path, name):
    (tmp_path / name).write_text("ObjectType = Image\n")
    with pytest.raises(
        SweepError, match=r"expected a sweep in one file \(\.igs\.mha, \.igs\.nrrd\), a plan, or poses"
    ):
        load_track(tmp_path / name)


def test_the_transducer_comes_to_be_where_the_probe_is_tracked():
    tracker = Tracker(placed(3.0, -2.0, 25.0))
    live = live_of(tracker)
    assert steps(live, 8) == pytest.approx(tracker.now)
    tracker.now = placed(-5.0)
    assert steps(live, 8) == pytest.approx(tracker.now)
    assert live.status == ""


def test_it_moves_no_faster_than_the_probe_manipulator():
    live = live_of(Tracker(placed(400.0)))
    before = at(live)
    # 150 mm/s, as the patient's scene has it.
    assert np.linalg.norm(steps(live, 1)[:3, 3] - before[:3, 3]) == pytest.approx(150.0 * STEP_S)


def test_while_tracking_is_lost_the_transducer_stays_and_the_status_shows_it():
    tracker = Tracker(placed(4.0))
    live = live_of(tracker)
    there = steps(live, 8)
    tracker.now = None
    assert np.array_equal(steps(live, 5, ray=ray(-6.0), press=True, push_mm=1.0), there)
    assert live.status == "TRACKING LOST"
    tracker.now = placed(6.0)
    assert steps(live, 8) == pytest.approx(tracker.now) and live.status == ""


def test_mouse_and_keys_do_not_move_a_tracked_probe_but_undo_works():
    live = live_of(Tracker(placed(2.0)))
    assert steps(live, 8, ray=ray(-6.0), press=True, rotate_deg=5.0) == pytest.approx(placed(2.0))
    steps(live, 10)
    step(live, undo=True)
    assert shown(live) == "undo" and at(live) != pytest.approx(placed(2.0))


def test_a_second_take_over_is_answered():
    live, said = live_of(Tracker(placed(2.0))), []
    for _ in range(2):
        step(live, take_over=True)
        said.append(shown(live))
    assert said == ["Mouse and keys control the probe", "Mouse and keys control the probe already"]
    replay, said = (
        ReplayInput(SimpleNamespace(is_over=False), lambda: UserInput(Session(Patient()))),
        [],
    )
    for controls in (Controls(Settings(), take_over=True), Controls(Settings())):
        replay.next_pose(controls)
        said.append(shown(replay))
    assert said == ["Mouse and keys control the probe", ""]


def test_after_an_undo_or_reset_it_stays_until_the_tracked_probe_moves():
    tracker = Tracker(placed(0.0))
    live = live_of(tracker)
    begun = live.session.rehearsal.pose
    steps(live, 8)
    assert step(live, reset=True) is None
    # Tremor and noise, in place and angle.
    for x, fan in ((0.0, 0.0), (2.5, 0.0), (-1.0, 2.5), (0.5, -2.0)):
        tracker.now = placed(x, tilt_deg=fan)
        step(live)
        assert np.array_equal(live.session.rehearsal.pose, begun)
    tracker.now = placed(3.5)
    assert steps(live, 8) == pytest.approx(tracker.now)
    step(live, reset=True)
    tracker.now = None
    steps(live, 3)
    tracker.now = placed(-9.0)
    step(live)
    assert np.array_equal(live.session.rehearsal.pose, begun), "found again is not moved"
    tracker.now = placed(-9.0, tilt_deg=4.0)
    assert steps(live, 8) == pytest.approx(tracker.now)


def test_one_that_takes_over_waits_as_well():
    tracker = Tracker(placed(5.0))
    live = UserInput(Session(Patient()), waits=True, tracked=tracker.pose)
    begun = at(live)
    assert np.array_equal(steps(live, 3), begun)
    tracker.now = placed(9.0)
    assert steps(live, 8) == pytest.approx(tracker.now)


@pytest.mark.parametrize(
    ("x", "tilt_deg", "is_moved"), [(2.9, 0, False), (3.1, 0, True), (0, 2.9, False), (0, -3.1, True)]
)
def test_what_counts_as_moved(x, tilt_deg, is_moved):
    assert has_moved(placed(0.0), placed(x, tilt_deg=tilt_deg)) is is_moved


def test_each_move_of_the_probe_is_an_action_and_rest_is_none():
    tracker = Tracker(placed(3.0))
    live = live_of(tracker)
    steps(live, 20)
    kept = len(live.session.kept_states)
    steps(live, 20, press=True)
    assert len(live.session.kept_states) == kept
    tracker.now = placed(-3.0)
    steps(live, 3)
    assert len(live.session.kept_states) == kept + 1


def way(count: int = 9, lost: tuple[int, ...] = ()) -> TimedPoses:
    """A quarter of a second from each to the next, 1.5 mm and 4 degrees on."""
    poses = [None if k in lost else placed(1.5 * k - 6.0, tilt_deg=4.0 * k) for k in range(count)]
    return TimedPoses(100.0 + 0.25 * np.arange(count), poses)


def test_poses_are_interpolated_in_position_and_angle():
    track = way()
    for time, share in ((0.0, 0.0), (0.25, 1.0), (0.1, 0.4), (1.1, 4.4), (2.0, 8.0), (5.0, 8.0)):
        expected = placed(1.5 * share - 6.0, tilt_deg=4.0 * share)
        assert track.at(time) == pytest.approx(expected), time


def test_next_to_a_frame_that_is_lost_the_pose_is_lost():
    track = way(lost=(3, 4, 8))
    known = {
        0.5: True,
        0.51: False,
        0.75: False,
        1.0: False,
        1.24: False,
        1.25: True,
        1.75: True,
        1.76: False,
        2.0: False,
    }
    assert {time: track.at(time) is not None for time in known} == known
    alone = TimedPoses(np.array([7.0]), [placed(1.0)])
    assert np.array_equal(alone.at(0.0), placed(1.0))


def test_a_file_is_played_at_the_sessions_time_and_then_the_user_is_the_input():
    session = Session(Patient())
    live = UserInput(session, tracked=partial(played_pose, way(), session))
    places = [at(live) for _ in range(17) if step(live) is not None]
    # From the second on the transducer keeps up: 6 mm/s.
    assert places[-1] == pytest.approx(placed(6.0, tilt_deg=32.0)) and places[9] == pytest.approx(
        placed(0.75, tilt_deg=18.0)
    )
    assert shown(live) == ""
    step(live, ray=ray(4.0))
    assert shown(live) == "End of the tracked file: mouse and keys control the probe" and live.status == ""
    assert np.array_equal(steps(live, 4, ray=ray(4.0)), places[-1])
    # A hand that fans by a degree turns what it has taken over where it is.
    step(live, tilt_deg=1.0)
    turned = places[-1][:3, :3].T @ at(live)[:3, :3]
    assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) == pytest.approx(1.0, abs=1e-3)
    assert np.linalg.norm(at(live)[:3, 3] - places[-1][:3, 3]) < 1.0
    assert steps(live, 4, ray=ray(-4.0))[0, 3] < Patient.origin[0]


def test_time_continues_through_resets():
    session = Session(Patient())
    played = partial(played_pose, way(), session)
    live = UserInput(session, tracked=played)
    steps(live, 6)
    for _ in range(4):
        step(live, reset=True)
    assert np.array_equal(played(), way().at(10 * STEP_S))
    # 0.57 - 0.07 is less than a half by rounding.
    half, other = TimedPoses(np.array([0.07, 0.57]), [placed(0.0), placed(1.0)]), Session(Patient())
    other.time_s = 4 * STEP_S
    assert half.length_s < 0.5 and np.array_equal(played_pose(half, other), placed(1.0))
    session.time_s = 16 * STEP_S
    assert isinstance(played(), np.ndarray)
    session.time_s = 17 * STEP_S
    with pytest.raises(TrackEnded):
        played()


def recorded(path: Path) -> str:
    """A tracked session recorded in a file; the tissue's digest at its end."""
    session = Session(Patient())
    played = partial(played_pose, way(25, lost=(5, 6, 13)), session)
    live = UserInput(session, SessionRecorder(session, path, header()), tracked=played)
    for moment in range(60):
        step(live, ray=ray(2.0), undo=moment == 30, reset=moment == 40, press=moment > 52)
        live.after_frame()
    live.recorder.close({})
    return session.rehearsal.digest()


def test_a_tracked_session_is_the_same_again_and_when_it_is_replayed(tmp_path):
    digest = recorded(tmp_path / "one")
    assert recorded(tmp_path / "two") == digest
    one, two = (read_log(tmp_path / name) for name in ("one", "two"))
    assert one.poses.tobytes() == two.poses.tobytes() and one.digests == two.digests
    assert np.isnan(one.poses[[30, 40], 0]).all() and np.abs(np.diff(one.poses[41:, 0, 3])).max() > 0.1
    replay = Replay(Patient(), one)
    while not replay.is_over:
        pose, _ = replay.move()
        if pose is not None:
            replay.rehearsal.advance(pose)
            replay.end_step()
    assert replay.differs_s is None and replay.compared == len(one.digests) > 5
    assert replay.rehearsal.digest() == digest


# Files


def sweep_file(path: Path, track: TimedPoses, name: str = "ProbeToReference") -> Path:
    unseen = transform_fields("StylusToReference", None)
    frames = [
        transform_fields(name, pose) | unseen | {"Timestamp": repr(float(time))}
        for time, pose in zip(track.times_s, track.poses, strict=True)
    ]
    write_sweep(path, Sweep(np.zeros((len(frames), 0, 0), np.uint8), frames, {}))
    return path


def poses_file(path: Path, track: TimedPoses) -> Path:
    rows = [
        dict(time_s=t, probe_to_patient=p.tolist()) for t, p in zip(track.times_s, track.poses, strict=True)
    ]
    path.write_text(json.dumps(rows))
    return path


def test_a_sweep_and_a_list_of_poses_give_the_same_way(tmp_path):
    track = way()
    sweeps = (sweep_file(tmp_path / f"a.igs.{kind}", track) for kind in ("mha", "nrrd"))
    for path in (*sweeps, poses_file(tmp_path / "a.json", track)):
        found = load_track(path)
        assert np.array_equal(found.times_s, track.times_s)
        assert all(np.array_equal(a, b) for a, b in zip(found.poses, track.poses, strict=True))
    lost = load_track(sweep_file(tmp_path / "b.igs.mha", way(lost=(2,))))
    assert [pose is None for pose in lost.poses] == [k == 2 for k in range(9)]


def test_the_transform_of_another_name_is_found_by_it_and_backwards(tmp_path):
    path = sweep_file(tmp_path / "a.igs.mha", way(), "PatientToWand")
    assert load_track(path, "WandToPatient").poses[3] == pytest.approx(np.linalg.inv(way().poses[3]))
    with pytest.raises(
        SweepError, match=r"a.igs.mha: frame 0: no chain of transforms from Probe to Reference"
    ):
        load_track(path)
    with pytest.raises(SweepError, match="StylusToReference has the status OK in none of 9 frames"):
        load_track(path, "StylusToReference")
    with pytest.raises(SweepError, match="--track-from 'Wand': expected a transform's name"):
        load_track(path, "Wand")
    with pytest.raises(PoseError, match="--track-from WandToPatient: .* a.json is not a sweep"):
        load_track(poses_file(tmp_path / "a.json", way()), "WandToPatient")


def test_a_sweep_without_usable_poses_is_refused_by_its_name(tmp_path):
    scaled = TimedPoses(np.arange(2.0), [placed(0.0), np.diag([2.0, 1, 1, 1])])
    with pytest.raises(PoseError, match=r"^a.igs.mha: frame 1: ProbeToReference is not rigid"):
        load_track(sweep_file(tmp_path / "a.igs.mha", scaled))
    text = (
        sweep_file(tmp_path / "b.igs.mha", way(2))
        .read_text()
        .replace("Timestamp = 100.25", "Timestamp = 100.0")
    )
    (tmp_path / "b.igs.mha").write_text(text)
    with pytest.raises(PoseError, match=r"^b.igs.mha: pose 2 at 100 s is not later"):
        load_track(tmp_path / "b.igs.mha")
    (tmp_path / "b.igs.mha").write_text(text.replace("Timestamp = 100.0", "Timestamp = soon"))
    with pytest.raises(SweepError, match=r"^b.igs.mha: frame 0: Timestamp"):
        load_track(tmp_path / "b.igs.mha")


def test_a_track_in_other_coordinates_is_refused_for_its_distance(tmp_path):
    organ = Patient.origin + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 12.0]])
    check_near(way(lost=(0,)), organ, tmp_path / "a.csv")
    one_near = TimedPoses(np.arange(2.0), [placed(500.0), placed(40.0)])
    check_near(one_near, organ, tmp_path / "a.csv")
    # The nearest is 300 mm beside the organ's top, and 8 mm above it.
    far = TimedPoses(np.arange(3.0), [placed(500.0), None, placed(300.0)])
    with pytest.raises(PoseError, match=r"^a.csv: the nearest pose is 300 mm from the organ; .*LPS, mm"):
        check_near(far, organ, tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--track", "none.csv"), "no such pose file"),
        (("--track", "none.igs.mha"), "none.igs.mha: No such file"),
        (("--track-from", "ProbeToReference"), "add its file with --track"),
        (("--track", "a.csv", "--replay", "b.jsonl"), "--track: a replay has the recorded poses"),
    ],
)
def test_the_command_line_refuses_in_one_line(options, words, capsys):
    assert app.main(["rehearse", "--headless", *options]) == 2
    told = capsys.readouterr().err
    assert words in told and len(told.strip().splitlines()) == 1


def test_the_samples_of_plus_are_refused_as_far_from_the_organ(data, capsys):
    assert app.main(["rehearse", "--headless", "--track", str(data / "us/NwirePhantomFreehand.igs.mha")]) == 2
    assert "mm from the organ; expected the probe's poses in this patient" in capsys.readouterr().err
