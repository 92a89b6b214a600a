"""Paths of the probe over the settled organ: parallel passes, in each of which the probe slides or tilts."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ultrasound.probe_manipulator import ProbeManipulator, advanced, pose_at, touching

# Largest distance and angle between poses of a pass.
STEP_MM, STEP_DEG = 1.5, 2.0
# Rays towards the organ's surface start this far outside [mm].
FAR_MM = 300.0


@dataclass(frozen=True)
class SweepPath:
    """``passes``: the poses (n, 4, 4) of each pass, with the probe in contact; between passes it is lifted."""

    passes: tuple[np.ndarray, ...]

    @property
    def poses(self) -> np.ndarray:
        """The poses (n, 4, 4) of all passes."""
        return np.concatenate(self.passes) if self.passes else np.zeros((0, 4, 4))


@dataclass(frozen=True)
class SweepLayout:
    """The frame in which passes are placed: ``centre`` (3,) [mm], and the orthonormal axes (3,) of it.

    ``outward`` points away from the organ, ``ahead`` along the passes, ``lateral`` across them.
    """

    centre: np.ndarray
    outward: np.ndarray
    ahead: np.ndarray
    lateral: np.ndarray

    def turned(self, lean_deg: tuple[float, float], heading_deg: float) -> "SweepLayout":
        """Rotated about lateral, then about ahead, and about outward [degrees]."""
        axes = np.column_stack([self.lateral, self.ahead, self.outward])
        turn = Rotation.from_euler("xyz", [*lean_deg, 0.0], degrees=True) * Rotation.from_euler(
            "z", heading_deg, degrees=True
        )
        lateral, ahead, outward = (axes @ turn.as_matrix()).T
        return SweepLayout(self.centre, outward, ahead, lateral)


def layout_towards(centre: np.ndarray, outward: np.ndarray, lateral: np.ndarray) -> SweepLayout:
    """The layout whose lateral axis is nearest to a direction."""
    x, ahead, z = pose_at(centre, -outward, lateral, 0.0)[:3, :3].T
    return SweepLayout(centre, z, ahead, x)


def sliding(
    manipulator: ProbeManipulator,
    layout: SweepLayout,
    aside_mm: np.ndarray,
    start_mm: float,
    end_mm: float,
    depth_mm: float,
    follow: float,
) -> SweepPath:
    """Passes along the surface at lateral offsets (k,), each from a start to an end along ``ahead``.

    The array face is ``depth_mm`` below the settled surface. The probe's axis is the layout's (``follow`` 0) or the surface normal (1).
    A pass ends where the organ ends; every second pass runs backwards.
    """
    count = max(2, int(np.ceil(abs(end_mm - start_mm) / STEP_MM)) + 1)
    passes = []
    for number, aside in enumerate(aside_mm):
        ahead = np.linspace(start_mm, end_mm, count)
        poses = [
            pose_over(manipulator, layout, aside, each, depth_mm, follow) for each in ahead[:: (-1) ** number]
        ]
        passes.append(_longest(poses))
    return SweepPath(tuple(each for each in passes if len(each) > 1))


def tilting(
    manipulator: ProbeManipulator,
    layout: SweepLayout,
    aside_mm: np.ndarray,
    ahead_mm: float,
    angles_deg: tuple[float, float],
    depth_mm: float,
) -> SweepPath:
    """Passes at lateral offsets (k,), in each of which the probe tilts out of its image plane about the centre of the array face."""
    count = max(2, int(np.ceil(abs(angles_deg[1] - angles_deg[0]) / STEP_DEG)) + 1)
    passes = []
    for number, aside in enumerate(aside_mm):
        upright = pose_over(manipulator, layout, aside, ahead_mm, depth_mm, 1.0)
        if upright is not None:
            angles = np.linspace(*angles_deg, count)[:: (-1) ** number]
            passes.append(np.stack([tilted(upright, manipulator.size_mm[2], each) for each in angles]))
    return SweepPath(tuple(passes))


def pose_over(
    manipulator: ProbeManipulator,
    layout: SweepLayout,
    aside_mm: float,
    ahead_mm: float,
    depth_mm: float,
    follow: float,
) -> np.ndarray | None:
    """The pose (4, 4) at an offset in a layout; None beside the organ."""
    over = layout.centre + aside_mm * layout.lateral + ahead_mm * layout.ahead
    place = manipulator.ray_hit(over + FAR_MM * layout.outward, -layout.outward)
    if place is None:
        return None
    axis = (1 - follow) * layout.outward + follow * manipulator.surface_normal(place)
    pose = pose_at(place, -axis, layout.lateral, manipulator.size_mm[2])
    return advanced(touching(pose, manipulator.size_mm, manipulator.samples, manipulator.radius_mm), depth_mm)


def tilted(pose: np.ndarray, length_mm: float, angle_deg: float) -> np.ndarray:
    """A pose rotated about its lateral axis through the centre of the array face."""
    turned = pose.copy()
    face = pose[:3, 3] - length_mm / 2 * pose[:3, 2]
    turned[:3, :3] = pose[:3, :3] @ Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()
    turned[:3, 3] = face + length_mm / 2 * turned[:3, 2]
    return turned


def _longest(poses: list[np.ndarray | None]) -> np.ndarray:
    """The longest run of poses (n, 4, 4) without a gap."""
    runs: list[list[np.ndarray]] = [[]]
    for pose in poses:
        if pose is None:
            runs.append([])
        else:
            runs[-1].append(pose)
    longest = max(runs, key=len)
    return np.stack(longest) if longest else np.zeros((0, 4, 4))
