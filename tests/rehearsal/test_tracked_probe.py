"""A tracked probe as input: the transducer follows, stays and waits; pose files."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import rotation_about
from fake_organ import STEP_S
from user_at_ball import ORIGIN, UserAtBall, ray

import app
from rehearsal.sources.tracker import TrackEnded, has_moved, played_pose
from rehearsal.tracking.pose_file import PoseError, TimedPoses
from rehearsal.tracking.track_file import check_near, load_track
from ultrasound.sweep import Sweep, SweepError, transform_fields
from ultrasound.sweep_file import write_sweep


def placed(x: float, y: float = 0.0, tilt_deg: float = 0.0) -> np.ndarray:
    """A probe 20 mm over the ball's middle and beside it, looking down: in PLUS's axes, in the patient."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_about([1, 0, 0], tilt_deg - 90.0)
    pose[:3, 3] = ORIGIN + [x, y, 20.0]
    return pose


class TrackedUser(UserAtBall):
    """A user whose probe is tracked where ``now`` says."""

    def __init__(self, now: np.ndarray | None, **options) -> None:
        self.now = now
        super().__init__(lambda time_s: self.now, **options)

    def steps(self, count: int, **did) -> np.ndarray:
        """The transducer's pose after so many frames."""
        return [self.step(**did) for _ in range(count)][-1]

    def is_there(self) -> bool:
        """Whether the transducer is where the probe is tracked."""
        return np.allclose(self.frame.pose, self.case.transducer_at(self.now))


def test_the_transducer_comes_to_be_where_the_probe_is_tracked():
    user = TrackedUser(placed(3.0, -2.0, 25.0))
    user.steps(8)
    assert user.is_there()
    user.now = placed(-5.0)
    user.steps(8)
    assert user.is_there() and user.source.status == ""


def test_it_moves_no_faster_than_the_probe_manipulator():
    user = TrackedUser(placed(400.0))
    user.manipulator.speed_mm_s, before = 150.0, user.frame.pose
    assert np.linalg.norm(user.step()[:3, 3] - before[:3, 3]) == pytest.approx(150.0 * STEP_S)


def test_while_tracking_is_lost_the_transducer_stays_and_the_status_shows_it():
    user = TrackedUser(placed(4.0))
    there = user.steps(8)
    user.now = None
    assert np.array_equal(user.steps(5, ray=ray(-6.0), press=True, push_mm=1.0), there)
    assert user.source.status == "TRACKING LOST"
    user.now = placed(6.0)
    user.steps(8)
    assert user.is_there() and user.source.status == ""


def test_mouse_and_keys_do_not_move_a_tracked_probe_but_undo_works():
    user = TrackedUser(placed(2.0))
    user.steps(8, ray=ray(-6.0), press=True, rotate_deg=5.0)
    assert user.is_there()
    user.step(undo=True)
    assert user.frame.restored and not user.is_there()


def test_a_second_take_over_is_answered():
    user = TrackedUser(placed(2.0))
    for answer in ("Mouse and keys control the probe", "Mouse and keys control the probe already"):
        user.step(take_over=True)
        assert user.said() == answer


def test_after_an_undo_or_reset_it_stays_until_the_tracked_probe_moves():
    user = TrackedUser(placed(0.0))
    begun = user.frame.pose
    user.steps(8)
    user.step(reset=True)
    # Tremor and noise, in place and angle.
    for x, fan in ((0.0, 0.0), (2.5, 0.0), (-1.0, 2.5), (0.5, -2.0)):
        user.now = placed(x, tilt_deg=fan)
        assert np.array_equal(user.step(), begun)
    user.now = placed(3.5)
    user.steps(8)
    assert user.is_there()
    user.step(reset=True)
    user.now = None
    user.steps(3)
    user.now = placed(-9.0)
    assert np.array_equal(user.step(), begun), "found again is not moved"
    user.now = placed(-9.0, tilt_deg=4.0)
    user.steps(8)
    assert user.is_there()


def test_one_that_takes_over_waits_as_well():
    user = TrackedUser(placed(5.0), waits=True)
    begun = user.frame.pose
    assert np.array_equal(user.steps(3), begun)
    user.now = placed(9.0)
    user.steps(8)
    assert user.is_there()


@pytest.mark.parametrize(
    ("x", "tilt_deg", "is_moved"), [(2.9, 0, False), (3.1, 0, True), (0, 2.9, False), (0, -3.1, True)]
)
def test_what_counts_as_moved(x, tilt_deg, is_moved):
    assert has_moved(placed(0.0), placed(x, tilt_deg=tilt_deg)) is is_moved


def test_each_move_of_the_probe_is_an_action_and_rest_is_none():
    user = TrackedUser(placed(3.0))
    user.steps(20)
    kept = len(user.frame.kept)
    user.steps(20, press=True)
    assert len(user.frame.kept) == kept
    user.now = placed(-3.0)
    user.steps(3)
    assert len(user.frame.kept) == kept + 1


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
    for times, is_known in (((0.5, 1.25, 1.75), True), ((0.51, 0.75, 1.0, 1.24, 1.76, 2.0), False)):
        assert [track.at(time) is not None for time in times] == [is_known] * len(times)
    alone = TimedPoses(np.array([7.0]), [placed(1.0)])
    assert np.array_equal(alone.at(0.0), placed(1.0))


def test_a_file_is_played_at_the_sessions_time_and_then_the_user_is_the_source():
    user = UserAtBall(partial(played_pose, way()))

    def is_at(pose: np.ndarray, x: float, tilt_deg: float) -> bool:
        return np.allclose(pose, user.case.transducer_at(placed(x, tilt_deg=tilt_deg)))

    poses = [user.step() for _ in range(17)]
    # From the second on the transducer keeps up: 6 mm/s.
    assert is_at(poses[-1], 6.0, 32.0) and is_at(poses[9], 0.75, 18.0) and user.said() == ""
    last = user.step(ray=ray(4.0))
    assert user.said() == "End of the tracked file: mouse and keys control the probe"
    assert user.source.status == "" and np.array_equal(last, poses[-1])
    for _ in range(4):
        assert np.array_equal(user.step(ray=ray(4.0)), last)
    # A hand that fans by a degree turns what it has taken over where it is.
    fanned = user.step(tilt_deg=1.0)
    turned = last[:3, :3].T @ fanned[:3, :3]
    assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) == pytest.approx(1.0, abs=1e-3)
    assert np.linalg.norm(fanned[:3, 3] - last[:3, 3]) < 1.0
    for _ in range(4):
        user.step(ray=ray(-4.0))
    assert user.frame.pose[0, 3] < 0


def test_a_files_time_continues_through_resets():
    times_s: list[float] = []
    user = UserAtBall(lambda time_s: times_s.append(time_s) or placed(0.0))
    for number in range(12):
        user.step(reset=number in (6, 8))
    # A way back takes a frame and no time.
    assert times_s == [STEP_S * number for number in range(10)]


def test_the_last_pose_of_a_file_is_given_and_nothing_after_it():
    assert np.array_equal(played_pose(way(), 16 * STEP_S), way().at(2.0))
    with pytest.raises(TrackEnded):
        played_pose(way(), 17 * STEP_S)
    # 0.57 - 0.07 is less than a half by rounding.
    half = TimedPoses(np.array([0.07, 0.57]), [placed(0.0), placed(1.0)])
    assert half.length_s < 0.5 and np.array_equal(played_pose(half, 4 * STEP_S), placed(1.0))


@pytest.mark.parametrize("name", ["a.igs.mhd", "a.igs.nhdr"])
def test_a_sweep_of_two_files_is_refused_with_what_is_read(tmp_path, name):
    (tmp_path / name).write_text("ObjectType = Image\n")
    with pytest.raises(
        SweepError, match=r"expected a sweep in one file \(\.igs\.mha, \.igs\.nrrd\), a plan, or poses"
    ):
        load_track(tmp_path / name)


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
        loaded = load_track(path)
        assert np.array_equal(loaded.times_s, track.times_s)
        assert all(np.array_equal(a, b) for a, b in zip(loaded.poses, track.poses, strict=True))
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
    organ = ORIGIN + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 12.0]])
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
    printed = capsys.readouterr().err
    assert words in printed and len(printed.strip().splitlines()) == 1


def test_the_samples_of_plus_are_refused_as_far_from_the_organ(data, capsys):
    assert app.main(["rehearse", "--headless", "--track", str(data / "us/NwirePhantomFreehand.igs.mha")]) == 2
    assert "mm from the organ; expected the probe's poses in this patient" in capsys.readouterr().err
