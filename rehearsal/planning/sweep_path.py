"""Paths of the probe over the settled organ: parallel passes, in each of which the probe slides or tilts; and
which of their poses an instrument through a trocar can hold.

A path is a list of passes, each the poses (n, 4, 4) of a probe in contact; between passes the probe is
lifted. A frame (4, 4) of ``frame_towards`` places the passes: x is across them, y along them, z away from the
organ, and its origin [mm] is their centre.
"""

import numpy as np
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from rehearsal.planning.plan_file import LIFT_MM
from scenes.scene import Trocar
from ultrasound.probe_manipulator import (
    ProbeManipulator,
    advanced,
    pose_at,
    poses_between,
    rigid,
    touching,
)

# Largest distance and angle between poses of a pass.
STEP_MM, STEP_DEG = 1.5, 2.0
# Lifts between two passes [mm], of which the least is taken that keeps the probe outside the organ, on ways
# at these steps.
LIFTS_MM, WAY_MM, ARC_DEG = (LIFT_MM, 12.0, 24.0, 48.0, 96.0), 3.0, 15.0
# Rays towards the organ's surface start this far outside [mm].
FAR_MM = 300.0
# Within this distance of the probe the shaft may touch the organ [mm].
NEAR_MM = 2.0


def frame_towards(centre: np.ndarray, outward: np.ndarray, lateral: np.ndarray) -> np.ndarray:
    """The frame at a place with its z along ``outward`` and its x nearest to ``lateral``."""
    return pose_at(centre, -outward, lateral, 0.0)


def turned(frame: np.ndarray, lean_deg: tuple[float, float], heading_deg: float) -> np.ndarray:
    """A frame rotated about its x, then about the y that it had, and about its own z [degrees]."""
    turn = Rotation.from_euler("xyz", [*lean_deg, 0.0], degrees=True) * Rotation.from_euler(
        "z", heading_deg, degrees=True
    )
    return rigid(frame[:3, :3] @ turn.as_matrix(), frame[:3, 3])


def sliding(
    manipulator: ProbeManipulator,
    frame: np.ndarray,
    aside_mm: np.ndarray,
    start_mm: float,
    end_mm: float,
    depth_mm: float,
    follow: float,
) -> list[np.ndarray]:
    """Passes along the surface at lateral offsets (k,), each from a start to an end along the frame's y.

    The array face is ``depth_mm`` below the settled surface. The probe's axis is the frame's z (``follow`` 0)
    or the surface normal (1). A pass ends where the organ ends; every second pass runs backwards.
    """
    count = max(2, int(np.ceil(abs(end_mm - start_mm) / STEP_MM)) + 1)
    passes = []
    for number, aside in enumerate(aside_mm):
        # The longest run of poses without a gap.
        runs: list[list[np.ndarray]] = [[]]
        ahead = np.linspace(start_mm, end_mm, count)[:: (-1) ** number]
        for pose in poses_over(manipulator, frame, aside, ahead, depth_mm, follow):
            if pose is None:
                runs.append([])
            else:
                runs[-1].append(pose)
        passes.append(max(runs, key=len))
    return [np.stack(run) for run in passes if len(run) > 1]


def tilting(
    manipulator: ProbeManipulator,
    frame: np.ndarray,
    aside_mm: np.ndarray,
    ahead_mm: float,
    angles_deg: tuple[float, float],
    depth_mm: float,
) -> list[np.ndarray]:
    """Passes at lateral offsets (k,), in each of which the probe tilts out of its image plane about the
    centre of the array face.
    """
    count = max(2, int(np.ceil(abs(angles_deg[1] - angles_deg[0]) / STEP_DEG)) + 1)
    passes = []
    for number, aside in enumerate(aside_mm):
        upright = pose_over(manipulator, frame, aside, ahead_mm, depth_mm, 1.0)
        if upright is not None:
            angles = np.linspace(*angles_deg, count)[:: (-1) ** number]
            passes.append(np.stack([tilted(upright, manipulator.size_mm[2], angle) for angle in angles]))
    return passes


def transfer(manipulator: ProbeManipulator, end: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The poses (n, 4, 4) of the probe, from the end of a pass to above the start of the next, which keep it
    outside the settled organ.

    It is lifted off, moves straight, at the least of ``LIFTS_MM`` at which that is possible, or else around
    the organ, and is lowered.
    """
    above = advanced(start, -LIFTS_MM[0])
    for lift in LIFTS_MM:
        ends = advanced(end, -lift), advanced(start, -lift)
        count = max(1, int(np.ceil(np.linalg.norm(ends[1][:3, 3] - ends[0][:3, 3]) / WAY_MM)))
        rising = [
            advanced(pose, -height)
            for pose in (end, start)
            for height in np.arange(LIFTS_MM[0], lift, WAY_MM)
        ]
        if clear_of_organ(manipulator, np.array([*rising, *poses_between(*ends, count)])).all():
            return np.array([*ends, above] if lift > LIFTS_MM[0] else ends)
    return np.array([*_around(manipulator, *ends), above])


def _around(manipulator: ProbeManipulator, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) from one to another on an arc about the middle of the organ, which is outside of it."""
    middle = manipulator.vertices.mean(axis=0)
    outside = np.linalg.norm(manipulator.vertices - middle, axis=1).max() + np.linalg.norm(
        manipulator.size_mm
    )
    arms = np.stack([start[:3, 3], end[:3, 3]]) - middle
    lengths = np.linalg.norm(arms, axis=1)
    turn = Rotation.align_vectors(arms[1:], arms[:1])[0].as_rotvec()
    count = max(2, int(np.ceil(np.linalg.norm(turn) / np.radians(ARC_DEG))))
    poses = poses_between(start, end, count)
    share = np.linspace(0.0, 1.0, count + 1)
    directions = Rotation.from_rotvec(share[:, None] * turn).apply(arms[0] / lengths[0])
    away = np.maximum(lengths[0] + share * (lengths[1] - lengths[0]), outside)
    poses[1:-1, :3, 3] = (middle + away[:, None] * directions)[1:-1]
    return poses


def pose_over(
    manipulator: ProbeManipulator,
    frame: np.ndarray,
    aside_mm: float,
    ahead_mm: float,
    depth_mm: float,
    follow: float,
) -> np.ndarray | None:
    """The pose (4, 4) at an offset in a frame; None beside the organ."""
    return poses_over(manipulator, frame, aside_mm, np.array([ahead_mm]), depth_mm, follow)[0]


def poses_over(
    manipulator: ProbeManipulator,
    frame: np.ndarray,
    aside_mm: float,
    ahead_mm: np.ndarray,
    depth_mm: float,
    follow: float,
) -> list[np.ndarray | None]:
    """The poses (4, 4) at offsets (n,) ahead in a frame; None beside the organ."""
    lateral, forwards, outward, centre = frame[:3].T
    above = centre + aside_mm * lateral + ahead_mm[:, None] * forwards + FAR_MM * outward
    distance = manipulator.ray_distances(above, np.tile(-outward, (len(above), 1)))
    over = np.isfinite(distance)
    places = above[over] - distance[over, None] * outward
    axes = (1 - follow) * outward + follow * manipulator.surface_normals(places)
    size, samples, radius = manipulator.size_mm, manipulator.samples, manipulator.radius_mm
    poses: list[np.ndarray | None] = [None] * len(above)
    for number, place, axis in zip(np.flatnonzero(over), places, axes, strict=True):
        pose = touching(pose_at(place, -axis, lateral, size[2]), size, samples, radius)
        poses[number] = advanced(pose, depth_mm)
    return poses


def tilted(pose: np.ndarray, length_mm: float, angle_deg: float) -> np.ndarray:
    """A pose rotated about its lateral axis through the centre of the array face."""
    result = pose.copy()
    face = pose[:3, 3] - length_mm / 2 * pose[:3, 2]
    result[:3, :3] = pose[:3, :3] @ Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()
    result[:3, 3] = face + length_mm / 2 * result[:3, 2]
    return result


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
