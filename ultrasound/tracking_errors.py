"""Tracking errors of a probe's poses: noise, calibration, latency, lost frames."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ultrasound.probe_manipulator import rigid


@dataclass(frozen=True)
class TrackingErrors:
    """Sizes of the errors, none negative; all 0 is a perfect tracker."""

    # Standard deviation of each coordinate and of the rotation about each axis, frame by frame.
    noise_mm: float = 0.0
    noise_deg: float = 0.0
    # Constant shift and rotation of the image relative to the probe; the seed gives the direction.
    calibration_mm: float = 0.0
    calibration_deg: float = 0.0
    # An image comes with the pose of this time earlier.
    latency_s: float = 0.0
    # Fraction of the frames without a pose (PLUS's status INVALID).
    lost: float = 0.0


def with_tracking_errors(
    poses: np.ndarray, times_s: np.ndarray, errors: TrackingErrors, seed: int = 0
) -> list[np.ndarray | None]:
    """Rigid ``poses`` (n, 4, 4) [mm], reference from probe, as a tracker reports them: None where lost.

    In this order: latency; noise, with rotation about the probe's origin; calibration, on the image's side
    (``pose @ calibration``). A ``seed`` draws the same pattern at every size of the errors, so that sizes can
    be compared. Raises ValueError where ``times_s`` (n,) do not increase.
    """
    if not (np.diff(times_s) > 0).all():
        raise ValueError("the times of poses must increase from each to the next")
    noise, calibration, losses = np.random.default_rng(seed).spawn(3)
    delayed = _delayed(poses, times_s, errors.latency_s)
    reported = _noisy(delayed, errors, noise) @ _calibration(errors, calibration)
    lost = losses.random(len(poses)) < errors.lost
    return [None if is_lost else pose for pose, is_lost in zip(reported, lost, strict=True)]


def _delayed(poses: np.ndarray, times: np.ndarray, latency_s: float) -> np.ndarray:
    """The poses of ``latency_s`` earlier; before the first, the first."""
    if latency_s == 0 or len(poses) < 2:
        return poses
    earlier = np.maximum(times - latency_s, times[0])
    turns = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(earlier)
    places = [np.interp(earlier, times, poses[:, axis, 3]) for axis in range(3)]
    return rigid(turns.as_matrix(), np.stack(places, axis=1))


def _noisy(poses: np.ndarray, errors: TrackingErrors, draw: np.random.Generator) -> np.ndarray:
    shifts = errors.noise_mm * draw.standard_normal((len(poses), 3))
    turns = np.radians(errors.noise_deg) * draw.standard_normal((len(poses), 3))
    turned = poses[:, :3, :3] @ Rotation.from_rotvec(turns).as_matrix()
    return rigid(turned, poses[:, :3, 3] + shifts)


def _calibration(errors: TrackingErrors, draw: np.random.Generator) -> np.ndarray:
    """The calibration error (4, 4): from the assumed image position to the true one."""
    direction, axis = (v / np.linalg.norm(v) for v in draw.standard_normal((2, 3)))
    turn = Rotation.from_rotvec(np.radians(errors.calibration_deg) * axis)
    return rigid(turn.as_matrix(), errors.calibration_mm * direction)
