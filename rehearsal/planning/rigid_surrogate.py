"""The rigid surrogate: score terms of a path if the settled organ did not deform. Rough, and some thirty times faster than a trial."""

import copy

import numpy as np
from scipy.ndimage import map_coordinates

from rehearsal.planning.sweep_score import ScoreTerms, path_mm
from rehearsal.planning.sweep_trial import Trial
from sim.fields import array_of
from sim.signed_distance import distance_grid
from sim.skinning import Skin
from ultrasound.coverage import REACH_MM, VOXEL_MM
from ultrasound.probe_manipulator import image_plane

# The most places of the target and elements of the array that are evaluated.
PLACES, ELEMENTS = 1500, 32


class RigidSurrogate:
    """Evaluates paths on the settled organ of a trial. Its ``manipulator`` has fewer samples of the surface than the trial's."""

    def __init__(self, trial: Trial) -> None:
        self.trial = trial
        self.manipulator = copy.copy(trial.rehearsal.manipulator)
        self.manipulator.samples = self.manipulator.vertices
        settled = Skin(trial.rehearsal.model, trial.places[:: -(-len(trial.places) // PLACES)])
        settled.update()
        self._places = array_of(settled.vertices).astype(float)
        self._distance, self._low_mm = distance_grid(
            self.manipulator.vertices, self.manipulator.faces, VOXEL_MM, REACH_MM
        )
        elements = trial.rehearsal.probe.elements()
        self._elements = elements[np.linspace(0, len(elements) - 1, ELEMENTS).astype(int)]

    def evaluate(self, passes: list[np.ndarray]) -> ScoreTerms:
        """The score terms on the rigid organ; compression is the depth of the array below its surface, and time is 0."""
        rehearsal, poses = self.trial.rehearsal, [pose for each in passes for pose in each]
        covered = np.zeros(len(self._places), bool)
        depths, contacts = [], []
        for pose in poses:
            plane = image_plane(pose, rehearsal.size_mm[2], 1.0, 1.0).world_from_plane
            outside = self._outside_mm(plane)
            touches = outside <= rehearsal.scene.image.contact_gap_mm
            covered |= self._in_image(plane, touches)
            depths.append(max(float(-outside.min()), 0.0))
            contacts.append(float(touches.mean()))
        length = path_mm(self.manipulator, np.array(poses)) if poses else 0.0
        return self.trial.terms(passes, depths, contacts, seen=float(covered.mean()), path_mm=length)

    def _outside_mm(self, plane: np.ndarray) -> np.ndarray:
        """The signed distance (k,) of each element from the settled surface, negative inside."""
        places = self._elements @ plane[:3, :2].T + plane[:3, 3]
        at = ((places - self._low_mm) / VOXEL_MM).T
        return map_coordinates(self._distance, at, order=1, mode="nearest")

    def _in_image(self, plane: np.ndarray, touches: np.ndarray) -> np.ndarray:
        """Which places of the target (n,) are on scanlines in contact."""
        probe = self.trial.rehearsal.probe
        x, y, z = ((self._places - plane[:3, 3]) @ plane[:3, :3]).T
        line, depth = probe.beam_coordinates(x, y)
        last = probe.number_of_scanlines - 1
        near = np.abs(z) <= (probe.elevation_width_mm + VOXEL_MM) / 2
        inside = near & (line >= -0.5) & (line <= last + 0.5) & (depth >= 0) & (depth <= probe.depth_mm)
        element = np.clip(np.rint(line / last * (len(touches) - 1)).astype(int), 0, len(touches) - 1)
        return inside & touches[element]
