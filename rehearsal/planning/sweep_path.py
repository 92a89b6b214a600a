"""Ways of the probe over the settled organ: passes side by side, in each of which it glides on or tilts in place."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ultrasound.probe_manipulator import ProbeManipulator, advanced, pose_at, touching

# Poses of a pass are no farther apart than this.
STEP_MM, STEP_DEG = 1.5, 2.0
# From so far outside the organ its surface is looked for [mm].
FAR_MM = 300.0


@dataclass(frozen=True)
class SweepPath:
    """``passes``: the poses (n, 4, 4) of each, along which the probe touches; between two of them it is lifted."""

    passes: tuple[np.ndarray, ...]

    @property
    def poses(self) -> np.ndarray:
        """All of them (n, 4, 4)."""
        return np.concatenate(self.passes) if self.passes else np.zeros((0, 4, 4))


@dataclass(frozen=True)
class SweepLayout:
    """Where passes lie: seen from ``outward``, around a ``centre`` (3,) [mm]; lateral is across the passes.

    ``outward``, ``ahead`` and ``lateral`` are unit vectors (3,) at right angles.
    """

    centre: np.ndarray
    outward: np.ndarray
    ahead: np.ndarray
    lateral: np.ndarray

    def turned(self, lean_deg: tuple[float, float], heading_deg: float) -> "SweepLayout":
        """Leant about lateral, then about ahead, and turned about outward [degrees]."""
        axes = np.column_stack([self.lateral, self.ahead, self.outward])
        turn = Rotation.from_euler("xyz", [*lean_deg, 0.0], degrees=True) * Rotation.from_euler(
            "z", heading_deg, degrees=True
        )
        lateral, ahead, outward = (axes @ turn.as_matrix()).T
        return SweepLayout(self.centre, outward, ahead, lateral)


def layout_towards(centre: np.ndarray, outward: np.ndarray, lateral: np.ndarray) -> SweepLayout:
    """A layout with the lateral direction nearest to one."""
    x, ahead, z = pose_at(centre, -outward, lateral, 0.0)[:3, :3].T
    return SweepLayout(centre, z, ahead, x)


def gliding(
    manipulator: ProbeManipulator,
    layout: SweepLayout,
    aside_mm: np.ndarray,
    start_mm: float,
    end_mm: float,
    depth_mm: float,
    follow: float,
) -> SweepPath:
    """Passes along the surface, at places aside (k,), each from a start to an end ahead of the centre.

    The probe is so deep under the settled surface and looks along the layout (``follow`` 0) or square to the surface (1). A pass
    ends where there is no organ under it; every other one goes back.
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
    """Passes at places aside (k,), in each of which the probe turns about its face's middle, out of its image plane."""
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
    """The pose (4, 4) at a place of a layout; None where there is no organ."""
    over = layout.centre + aside_mm * layout.lateral + ahead_mm * layout.ahead
    place = manipulator.ray_hit(over + FAR_MM * layout.outward, -layout.outward)
    if place is None:
        return None
    looks = (1 - follow) * layout.outward + follow * manipulator.surface_normal(place)
    pose = pose_at(place, -looks, layout.lateral, manipulator.size_mm[2])
    return advanced(touching(pose, manipulator.size_mm, manipulator.samples, manipulator.radius_mm), depth_mm)


def tilted(pose: np.ndarray, length_mm: float, angle_deg: float) -> np.ndarray:
    """A pose turned about its lateral axis through the face's middle."""
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
