"""The rigid surrogate: score terms of a path if the settled organ did not deform. Rough, and some thirty times faster than a trial."""

import copy

import numpy as np
from scipy.ndimage import map_coordinates

from rehearsal.planning.instrument_reach import InstrumentReach
from rehearsal.planning.sweep_path import SweepPath
from rehearsal.planning.sweep_score import ScoreTerms, incidence_deg, path_mm
from rehearsal.rehearsal import Rehearsal
from sim.fields import array_of
from sim.signed_distance import distance_grid
from sim.skinning import Skin
from ultrasound.coverage import REACH_MM, VOXEL_MM, Coverage
from ultrasound.probe_manipulator import image_plane

# The most places of the target and elements of the array that are evaluated.
PLACES, ELEMENTS = 1500, 32


class RigidSurrogate:
    """Evaluates paths on one settled organ. Its ``manipulator`` has fewer samples of the surface than a trial's."""

    def __init__(self, rehearsal: Rehearsal, coverage: Coverage, target: str, reach: InstrumentReach) -> None:
        self.rehearsal, self.reach = rehearsal, reach
        self.manipulator = copy.copy(rehearsal.manipulator)
        self.manipulator.samples = self.manipulator.vertices
        places = coverage.voxel_centres(target)
        settled = Skin(rehearsal.model, places[:: -(-len(places) // PLACES)])
        settled.update()
        self._places = array_of(settled.vertices).astype(float)
        self._distance, self._low_mm = distance_grid(
            self.manipulator.vertices, self.manipulator.faces, VOXEL_MM, REACH_MM
        )
        elements = rehearsal.probe.elements()
        self._elements = elements[np.linspace(0, len(elements) - 1, ELEMENTS).astype(int)]

    def evaluate(self, path: SweepPath) -> ScoreTerms:
        """The score terms on the rigid organ; compression is the depth of the array below its surface, and time is 0."""
        if not path.passes:
            return ScoreTerms.zero()
        covered = np.zeros(len(self._places), bool)
        depths, contacts = [], []
        for pose in path.poses:
            plane = image_plane(pose, self.rehearsal.size_mm[2], 1.0, 1.0).world_from_plane
            outside = self._outside_mm(plane)
            touches = outside <= self.rehearsal.scene.image.contact_gap_mm
            covered |= self._in_image(plane, touches)
            depths.append(max(float(-outside.min()), 0.0))
            contacts.append(float(touches.mean()))
        compression = np.array(depths)
        return ScoreTerms(
            seen=float(covered.mean()),
            compression_mean_mm=float(compression.mean()),
            compression_max_mm=float(compression.max()),
            over_limit=float((compression > self.rehearsal.scene.transducer.compression_warning_mm).mean()),
            contact=float(np.mean(contacts)),
            incidence_deg=incidence_deg(self.manipulator, path.poses),
            path_mm=path_mm(self.manipulator, path.poses),
            time_s=0.0,
            reachable=float(self.reach(path.poses).mean()),
        )

    def _outside_mm(self, plane: np.ndarray) -> np.ndarray:
        """The signed distance (k,) of each element from the settled surface, negative inside."""
        places = self._elements @ plane[:3, :2].T + plane[:3, 3]
        at = ((places - self._low_mm) / VOXEL_MM).T
        return map_coordinates(self._distance, at, order=1, mode="nearest")

    def _in_image(self, plane: np.ndarray, touches: np.ndarray) -> np.ndarray:
        """Which places of the target (n,) are on scanlines in contact."""
        probe = self.rehearsal.probe
        x, y, z = ((self._places - plane[:3, 3]) @ plane[:3, :3]).T
        line, depth = probe.beam_coordinates(x, y)
        last = probe.number_of_scanlines - 1
        near = np.abs(z) <= (probe.elevation_width_mm + VOXEL_MM) / 2
        inside = near & (line >= -0.5) & (line <= last + 0.5) & (depth >= 0) & (depth <= probe.depth_mm)
        element = np.clip(np.rint(line / last * (len(touches) - 1)).astype(int), 0, len(touches) - 1)
        return inside & touches[element]
