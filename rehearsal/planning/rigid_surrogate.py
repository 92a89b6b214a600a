"""The rigid surrogate: what a pass shows if the settled organ does not deform.

Rough, and a hundred times faster than a trial.
"""

import copy

import numpy as np
from scipy.ndimage import map_coordinates

from rehearsal.planning.pass_kinds import PassKind
from rehearsal.planning.sweep_score import TriedPass
from rehearsal.planning.sweep_trial import Trial
from sim.fields import array_of
from sim.signed_distance import distance_grid
from ultrasound.coverage import REACH_MM, VOXEL_MM
from ultrasound.probe_manipulator import image_plane

# The most elements of the array that are evaluated.
ELEMENTS = 32


class RigidSurrogate:
    """Evaluates passes on the settled organ of a trial.

    Its ``manipulator`` has fewer samples of the surface than the trial's.
    """

    def __init__(self, trial: Trial) -> None:
        self.trial = trial
        trial.rehearsal.reset()
        self.manipulator = copy.copy(trial.manipulator)
        self.manipulator.samples = self.manipulator.vertices
        settled = trial.rehearsal.anatomy.skin(trial.sampled_places)
        self._places = array_of(settled.vertices).astype(float)
        self._distance, self._low_mm = distance_grid(
            self.manipulator.vertices, self.manipulator.faces, VOXEL_MM, REACH_MM
        )
        probe, gap_mm = trial.case.probe, trial.case.scene.image.coupling_gap_mm
        some = np.linspace(0, probe.number_of_scanlines - 1, ELEMENTS).astype(int)
        self._elements = probe.elements()[some]
        # Where these are inside the organ, the elements are in contact (as ``Propagation``).
        self._gap_ends = self._elements + gap_mm * probe.face_normals()[some]

    def try_pass(self, kind: PassKind, parameters: np.ndarray) -> TriedPass | None:
        """A pass over the rigid organ; None where the instrument cannot hold it.

        Compression is the depth of the array below the surface.
        """
        poses = kind.poses(self.manipulator, kind.values(parameters))
        if poses is None or not self.trial.held([poses]).all():
            return None
        planes = image_plane(poses, self.trial.case.size_mm[2], 1.0, 1.0).world_from_plane
        touches = self._outside_mm(planes, self._gap_ends) <= 0
        depths = np.maximum(-self._outside_mm(planes, self._elements).min(axis=1), 0.0)
        return self.trial.tried(
            parameters, poses, self._covered(planes, touches), depths, touches.mean(axis=1)
        )

    def _outside_mm(self, planes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The signed distance (n, k) of points (k, 2) on planes (n, 4, 4) from the settled surface, negative
        inside.
        """
        places = np.einsum("kj,nij->nki", points, planes[:, :3, :2]) + planes[:, None, :3, 3]
        at = ((places - self._low_mm) / VOXEL_MM).reshape(-1, 3).T
        return map_coordinates(self._distance, at, order=1, mode="nearest").reshape(places.shape[:2])

    def _covered(self, planes: np.ndarray, touches: np.ndarray) -> np.ndarray:
        """Which places of the target (p,) are on scanlines in contact, on any of the planes (n, 4, 4)."""
        probe, axes, origins = self.trial.case.probe, planes[:, :3, :3], planes[:, :3, 3]
        aside = self._places @ axes[:, :, 2].T - np.einsum("ni,ni->n", origins, axes[:, :, 2])
        place, n = np.nonzero(np.abs(aside) <= (probe.elevation_width_mm + VOXEL_MM) / 2)
        x, y = np.einsum("ki,kij->jk", self._places[place] - origins[n], axes[n, :, :2])
        line, depth = probe.beam_coordinates(x, y)
        last = probe.number_of_scanlines - 1
        inside = (line >= -0.5) & (line <= last + 0.5) & (depth >= 0) & (depth <= probe.depth_mm)
        element = np.rint(line / last * (touches.shape[1] - 1)).astype(int)
        inside &= touches[n, np.clip(element, 0, touches.shape[1] - 1)]
        return np.bincount(place[inside], minlength=len(self._places)) > 0
