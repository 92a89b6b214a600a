"""Whether an instrument through a trocar can hold the probe at a pose."""

import numpy as np
from scipy.spatial.distance import cdist

from scenes.scene import Trocar
from ultrasound.probe_manipulator import ProbeManipulator

# Within this distance of the probe the shaft may touch the organ [mm].
NEAR_MM = 2.0


def reachable(
    trocar: Trocar, manipulator: ProbeManipulator, origin: np.ndarray, target: np.ndarray, poses: np.ndarray
) -> np.ndarray:
    """Which poses (n, 4, 4) over the settled organ are reachable, bool (n,); all are without a trocar.

    ``origin`` (3,) is the rehearsal's origin in the patient [mm]. The shaft is straight, from the trocar to
    the centre of the probe's back. Without an axis of its own, the trocar's cone is about the direction to
    ``target`` (3,).
    """
    if trocar.at_mm is None:
        return np.ones(len(poses), bool)
    at = np.array(trocar.at_mm) - origin
    axis = target - at if trocar.axis is None else np.array(trocar.axis)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
    shafts = poses[:, :3, 3] + manipulator.size_mm[2] / 2 * poses[:, :3, 2] - at
    length = np.linalg.norm(shafts, axis=1)
    along = shafts / np.maximum(length, 1e-9)[:, None]
    can = (length <= trocar.longest_mm) & _within(along @ axis, trocar.cone_deg)
    can &= _within(-np.einsum("ij,ij->i", along, poses[:, :3, 2]), trocar.wrist_deg)
    free = manipulator.ray_distances(np.repeat(at[None], can.sum(), axis=0), along[can])
    can[can] = free > length[can] - NEAR_MM
    return can


def clear_of_organ(manipulator: ProbeManipulator, poses: np.ndarray) -> np.ndarray:
    """Whether the probe is outside the settled organ at each of the poses (n, 4, 4), bool (n,)."""
    half = manipulator.size_mm / 2
    samples = manipulator.samples
    clear = np.ones(len(poses), bool)
    # Few poses are so near that a point of the surface may be in the probe.
    least = cdist(poses[:, :3, 3], samples, "sqeuclidean").min(axis=1)
    for number in np.flatnonzero(least < half @ half):
        local = (samples - poses[number, :3, 3]) @ poses[number, :3, :3]
        clear[number] = not (np.abs(local) < half).all(axis=1).any()
    return clear


def _within(cosine: np.ndarray, most_deg: float) -> np.ndarray:
    return cosine >= np.cos(np.radians(most_deg)) - 1e-9
