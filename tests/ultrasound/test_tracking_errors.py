"""What a tracker gets wrong of a probe's poses."""

import numpy as np
import pytest
from conftest import rotation_about
from scipy.spatial.transform import Rotation

from rehearsal.reconstruction.sweep_volumes import with_errors
from studies.freehand.freehand_sweeps import sweep_of
from ultrasound.sweep import Sweep, SweepError
from ultrasound.tracking_errors import TrackingErrors, with_tracking_errors

FRAMES = 4000
# Estimates are off by a standard error now and then, hardly ever by four.
SIGMAS = 4.0
EVERYTHING = TrackingErrors(0.5, 1.0, 2.0, 3.0, 0.1)


def sweep(count: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """A probe that moves at (10, -20, 5) mm/s and turns at 40 deg/s about an axis of its own, at 50 Hz."""
    times = 3.0 + np.arange(count) / 50
    poses = np.tile(np.eye(4), (count, 1, 1))
    start = rotation_about([1, 2, -1], 70)
    poses[:, :3, :3] = start @ np.array([rotation_about([2, 1, 2], 40 * t) for t in times])
    poses[:, :3, 3] = [7.0, -80.0, 30.0] + times[:, None] * [10.0, -20.0, 5.0]
    return poses, times


def reported(errors: TrackingErrors, seed: int = 0) -> np.ndarray:
    poses, times = sweep()
    return np.array(with_tracking_errors(poses, times, errors, seed))


def turns_deg(reported_poses: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3) from true to found, in the probe's axes."""
    return Rotation.from_matrix(np.swapaxes(poses[:, :3, :3], 1, 2) @ reported_poses[:, :3, :3]).as_rotvec(
        degrees=True
    )


def test_a_perfect_tracker_reports_the_very_poses():
    np.testing.assert_array_equal(reported(TrackingErrors()), sweep()[0])


def test_noise_has_the_deviation_asked_for_on_every_axis_and_no_two_axes_or_frames_go_together():
    poses, _ = sweep()
    noisy = reported(TrackingErrors(noise_mm=0.6, noise_deg=0.8))
    drawn = np.hstack([(noisy - poses)[:, :3, 3] / 0.6, turns_deg(noisy, poses) / 0.8])
    # Standard errors of n normal values: deviation 1/sqrt(2n), mean and correlation 1/sqrt(n).
    assert np.abs(drawn.std(axis=0) - 1).max() < SIGMAS / np.sqrt(2 * FRAMES)
    assert np.abs(drawn.mean(axis=0)).max() < SIGMAS / np.sqrt(FRAMES)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(6)).max() < SIGMAS / np.sqrt(FRAMES)
    assert np.abs((drawn[1:] * drawn[:-1]).mean(axis=0)).max() < SIGMAS / np.sqrt(FRAMES)


def test_noise_turns_about_the_probes_own_axes_whatever_its_pose():
    poses, times = sweep(50)
    upright = np.tile(np.eye(4), (50, 1, 1))
    errors = TrackingErrors(noise_deg=3.0)
    turns = [turns_deg(np.array(with_tracking_errors(way, times, errors)), way) for way in (poses, upright)]
    np.testing.assert_allclose(*turns, atol=1e-9)


def test_calibration_is_one_shift_and_turn_of_the_image_against_the_probe():
    poses, _ = sweep()
    shifted = reported(TrackingErrors(calibration_mm=2.5, calibration_deg=4.0))
    calibration = np.linalg.inv(poses) @ shifted
    # Positions are some 1000 mm large, of which float64 keeps 1e-13.
    np.testing.assert_allclose(calibration, np.broadcast_to(calibration[0], poses.shape), atol=1e-11)
    assert np.linalg.norm(calibration[0, :3, 3]) == pytest.approx(2.5, abs=1e-11)
    assert Rotation.from_matrix(calibration[0, :3, :3]).magnitude() == pytest.approx(
        np.radians(4.0), abs=1e-11
    )


def test_the_directions_of_calibration_come_from_the_seed():
    errors, (poses, times) = TrackingErrors(calibration_mm=1.0, calibration_deg=1.0), sweep(1)
    shifted = np.concatenate(
        [np.array(with_tracking_errors(poses, times, errors, seed)) for seed in range(30)]
    )
    shifts, axes = (shifted - poses)[:, :3, 3], turns_deg(shifted, poses)
    # Of n directions the mean is 0, each of its coordinates with a standard error of 1 / sqrt(3 n).
    assert np.abs([shifts.mean(axis=0), axes.mean(axis=0)]).max() < SIGMAS / np.sqrt(3 * 30)
    assert np.abs((shifts @ poses[0, :3, :3] * axes).sum(axis=1).mean()) < SIGMAS / np.sqrt(3 * 30)


def test_calibration_comes_after_noise():
    poses, _ = sweep()
    noise, calibration = dict(noise_mm=0.5, noise_deg=2.0), dict(calibration_mm=2.5, calibration_deg=4.0)
    image_from_probe = np.linalg.inv(poses[0]) @ reported(TrackingErrors(**calibration))[0]
    expected = reported(TrackingErrors(**noise)) @ image_from_probe
    np.testing.assert_allclose(reported(TrackingErrors(**noise, **calibration)), expected, atol=1e-11)


def test_latency_is_the_pose_of_so_much_earlier():
    poses, times = sweep()
    late_poses, latency = reported(TrackingErrors(latency_s=0.073)), 0.073
    # Motion and turn are uniform, so that interpolation is exact; those before are the first.
    late = times - times[0] > latency
    np.testing.assert_allclose(
        (poses - late_poses)[late, :3, 3], np.tile(latency * np.array([10, -20, 5]), (late.sum(), 1))
    )
    axis = np.array([2, 1, 2]) / 3
    np.testing.assert_allclose(
        turns_deg(late_poses, poses)[late], np.tile(-40 * latency * axis, (late.sum(), 1)), atol=1e-9
    )
    assert np.count_nonzero(~late) == 4
    np.testing.assert_allclose(late_poses[~late], np.broadcast_to(poses[0], (4, 4, 4)), atol=1e-13)


def test_a_single_pose_has_nothing_earlier():
    poses, times = sweep(1)
    np.testing.assert_array_equal(
        with_tracking_errors(poses, times, TrackingErrors(latency_s=1.0))[0], poses[0]
    )


@pytest.mark.parametrize("lost", [0.03, 0.4, 1.0])
def test_the_share_of_lost_frames_is_that_asked_for(lost):
    poses, times = sweep()
    gone = np.array([pose is None for pose in with_tracking_errors(poses, times, TrackingErrors(lost=lost))])
    # The standard error of a share of n independent frames.
    assert abs(gone.mean() - lost) <= SIGMAS * np.sqrt(lost * (1 - lost) / FRAMES)
    # In a row as often as chance has it, whose standard error is at most that of so many pairs.
    assert abs((gone[1:] & gone[:-1]).mean() - lost**2) < 2 * SIGMAS * lost / np.sqrt(FRAMES)


def test_what_is_reported_is_rigid():
    noisy = reported(EVERYTHING)
    rotation = noisy[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-12
    )
    assert (np.linalg.det(rotation) > 0).all()
    np.testing.assert_array_equal(noisy[:, 3], np.tile([0, 0, 0, 1], (FRAMES, 1)))


def test_a_seed_gives_the_same_poses_and_another_gives_others():
    np.testing.assert_array_equal(reported(EVERYTHING, 5), reported(EVERYTHING, 5))
    assert (reported(EVERYTHING, 5) != reported(EVERYTHING, 6))[:, :3].all()


def test_a_seed_draws_one_pattern_at_any_size_and_whatever_is_lost():
    poses, times = sweep()
    small = reported(TrackingErrors(noise_mm=0.1)) - poses
    large = with_tracking_errors(poses, times, TrackingErrors(noise_mm=0.8, lost=0.3))
    for pose, true, step in zip(large, poses, small, strict=True):
        if pose is not None:
            np.testing.assert_allclose((pose - true)[:3, 3], 8 * step[:3, 3], atol=1e-11)


def test_times_that_do_not_increase_are_refused():
    poses, times = sweep(5)
    with pytest.raises(ValueError, match="increase"):
        with_tracking_errors(poses, times[::-1], TrackingErrors())


def recorded(count: int = 6) -> Sweep:
    """A sweep along x whose third frame has no pose."""
    poses: list[np.ndarray | None] = list(sweep(count)[0])
    poses[2] = None
    return sweep_of(np.ones((count, 4, 4), np.uint8), poses, np.arange(count) / 30, np.eye(4))


def test_a_recorded_sweep_gets_the_errors_of_a_tracker_and_keeps_what_it_had_lost():
    before, errors = recorded(), TrackingErrors(noise_mm=1.0, calibration_mm=2.0)
    after = with_errors(before, "Reference", errors, seed=3)
    known = [0, 1, 3, 4, 5]
    poses = np.stack([before.transform("Probe", "Reference", k) for k in known])
    expected = with_tracking_errors(poses, before.times_s[known], errors, 3)
    for k, pose in zip(known, expected, strict=True):
        assert np.array_equal(after.transform("Probe", "Reference", k), pose)
        assert not np.allclose(pose, before.transform("Probe", "Reference", k))
    assert after.transform("Probe", "Reference", 2) is None
    # The picture goes with the probe, and the sweep that was recorded stays as it was.
    assert np.array_equal(after.transform("Image", "Reference", 4), expected[3])
    assert before.frames == recorded().frames


def test_frames_that_the_tracker_loses_have_no_pose():
    after = with_errors(recorded(), "Reference", TrackingErrors(lost=1.0), 0)
    assert all(after.transform("Probe", "Reference", k) is None for k in range(len(after)))
    with pytest.raises(SweepError, match="no frame has a pose"):
        with_errors(after, "Reference", TrackingErrors(noise_mm=1.0), 0)


def test_errors_on_times_that_do_not_grow_are_refused():
    still = recorded()
    still.frames[4]["Timestamp"] = still.frames[3]["Timestamp"]
    with pytest.raises(SweepError, match="times"):
        with_errors(still, "Reference", TrackingErrors(latency_s=0.1), 0)
