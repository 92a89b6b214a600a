"""What a way would be worth if the settled organ did not give way: rough, and some thirty times faster than a trial."""

import copy

import numpy as np
from scipy.ndimage import map_coordinates

from rehearsal.planning.instrument_reach import Reach
from rehearsal.planning.score_terms import ScoreTerms, incidence_deg, path_mm
from rehearsal.planning.sweep_path import SweepPath
from rehearsal.rehearsal import Rehearsal
from sim.fields import array_of
from sim.signed_distance import distance_grid
from sim.skinning import Skin
from ultrasound.coverage import REACH_MM, VOXEL_MM, Coverage
from ultrasound.probe_manipulator import image_plane

# Of the target no more places than these are asked for, and of the array no more elements.
PLACES, ELEMENTS = 1500, 32


class RigidSurrogate:
    """Ways on one settled organ; ``hand`` lays them with fewer samples of its surface than a trial's."""

    def __init__(self, rehearsal: Rehearsal, coverage: Coverage, target: str, reach: Reach) -> None:
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
        probe = rehearsal.probe
        elements = probe.elements()
        self._elements = elements[np.linspace(0, len(elements) - 1, ELEMENTS).astype(int)]

    def parts(self, way: SweepPath) -> ScoreTerms:
        """The same figures as a trial's, of the rigid organ; ``compression`` is how deep the array is in it."""
        if not way.passes:
            return ScoreTerms.nothing()
        seen = np.zeros(len(self._places), bool)
        deepest, touching = [], []
        for pose in way.poses:
            plane = image_plane(pose, self.rehearsal.size_mm[2], 1.0, 1.0).world_from_plane
            outside = self._outside_mm(plane)
            touches = outside <= self.rehearsal.scene.image.contact_gap_mm
            seen |= self._shown(plane, touches)
            deepest.append(max(float(-outside.min()), 0.0))
            touching.append(float(touches.mean()))
        squeezed = np.array(deepest)
        return ScoreTerms(
            seen=float(seen.mean()),
            compression_mean_mm=float(squeezed.mean()),
            compression_max_mm=float(squeezed.max()),
            over_limit=float((squeezed > self.rehearsal.scene.transducer.compression_warning_mm).mean()),
            contact=float(np.mean(touching)),
            incidence_deg=incidence_deg(self.manipulator, way.poses),
            path_mm=path_mm(self.manipulator, way.poses),
            time_s=0.0,
            reachable=float(self.reach(way.poses).mean()),
        )

    def _outside_mm(self, plane: np.ndarray) -> np.ndarray:
        """How far each element (k,) is from the settled surface, negative inside."""
        places = self._elements @ plane[:3, :2].T + plane[:3, 3]
        at = ((places - self._low_mm) / VOXEL_MM).T
        return map_coordinates(self._distance, at, order=1, mode="nearest")

    def _shown(self, plane: np.ndarray, touches: np.ndarray) -> np.ndarray:
        """Which places of the target (n,) are on the picture's lines that touch."""
        probe = self.rehearsal.probe
        x, y, z = ((self._places - plane[:3, 3]) @ plane[:3, :3]).T
        line, depth = probe.beam_coordinates(x, y)
        last = probe.number_of_scanlines - 1
        near = np.abs(z) <= (probe.elevation_width_mm + VOXEL_MM) / 2
        inside = near & (line >= -0.5) & (line <= last + 0.5) & (depth >= 0) & (depth <= probe.depth_mm)
        element = np.clip(np.rint(line / last * (len(touches) - 1)).astype(int), 0, len(touches) - 1)
        return inside & touches[element]
