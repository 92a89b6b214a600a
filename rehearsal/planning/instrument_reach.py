"""Whether an instrument through a trocar can hold the probe at a pose."""

import igl
import numpy as np

from scenes.scene import Trocar
from ultrasound.probe_manipulator import ProbeManipulator

# Within this distance of the probe the shaft may touch the organ [mm].
NEAR_MM = 2.0


class InstrumentReach:
    """A trocar and the settled organ. ``origin`` (3,) is the rehearsal's origin in the patient [mm].

    The shaft is straight, from the trocar to the centre of the probe's back. Without an axis of its own, the cone is about the
    direction to ``target`` (3,).
    """

    def __init__(
        self, trocar: Trocar, manipulator: ProbeManipulator, origin: np.ndarray, target: np.ndarray
    ) -> None:
        self.trocar, self.manipulator = trocar, manipulator
        self.at = None if trocar.at_mm is None else np.array(trocar.at_mm) - origin
        axis = (
            np.array(trocar.axis)
            if trocar.axis is not None
            else target - (self.at if self.at is not None else 0)
        )
        self.axis = axis / max(float(np.linalg.norm(axis)), 1e-9)

    def __call__(self, poses: np.ndarray) -> np.ndarray:
        """Which poses (n, 4, 4) are reachable, bool (n,)."""
        if self.at is None:
            return np.ones(len(poses), bool)
        backs = poses[:, :3, 3] + self.manipulator.size_mm[2] / 2 * poses[:, :3, 2]
        shafts = backs - self.at
        length = np.linalg.norm(shafts, axis=1)
        along = shafts / np.maximum(length, 1e-9)[:, None]
        can = (length <= self.trocar.longest_mm) & _within(along @ self.axis, self.trocar.cone_deg)
        can &= _within(-np.einsum("ij,ij->i", along, poses[:, :3, 2]), self.trocar.wrist_deg)
        for n in np.flatnonzero(can):
            can[n] = self._is_free(along[n], length[n])
        return can

    def _is_free(self, along: np.ndarray, length_mm: float) -> bool:
        """Whether the shaft does not pass through the organ."""
        hits = igl.ray_mesh_intersect(self.at, along, self.manipulator.vertices, self.manipulator.faces)
        return not hits or hits[0][1] > length_mm - NEAR_MM


def _within(cosine: np.ndarray, most_deg: float) -> np.ndarray:
    return cosine >= np.cos(np.radians(most_deg)) - 1e-9
