"""A crater: the place of removed tissue in volumes at rest, with fluid or air in it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates

from sim.signed_distance import clipped_distance_grid, signed_distance
from ultrasound.acoustics import properties
from ultrasound.sampled_volume import AIR_HU, SampledVolume

Filling = Literal["fluid", "air"]
FILLINGS: tuple[Filling, ...] = get_args(Filling)
# HU of each, and the tissue whose acoustic values it has, where it has a tissue's: irrigation fluid with some
# blood is as urine.
HU: dict[Filling, float] = {"fluid": 10.0, "air": AIR_HU}
TISSUE: dict[Filling, str] = {"fluid": "urine"}
# Voxels that a surface crosses are shared by the distance to it, interpolated on a grid of the first spacing
# up to the second.
FINE_MM, NEAR_MM = 0.6, 3.0
Box = tuple[slice, slice, slice]


@dataclass(frozen=True)
class Crater:
    """The inside of a closed surface at rest [mm], and what fills it."""

    surface: trimesh.Trimesh
    filling: Filling

    def hu(self) -> np.ndarray:
        """HU in it, shape ()."""
        return np.array(HU[self.filling], np.float32)

    def acoustics(self) -> np.ndarray:
        """Acoustic properties (4,) in it, as ``acoustics.properties``."""
        hu = np.full((1, 1, 1), round(HU[self.filling]), np.int32)
        tissue = TISSUE.get(self.filling)
        labels = np.zeros((1, 1, 1), np.int32) if tissue is None else np.ones((1, 1, 1), np.int32)
        return properties(hu, labels, {} if tissue is None else {1: tissue})[0, 0, 0]

    @cached_property
    def _distances(self) -> tuple[np.ndarray, np.ndarray]:
        """Signed distances [mm] from the surface on a fine grid, up to NEAR_MM, and the grid's first point
        (3,).
        """
        low = self.surface.bounds[0] - NEAR_MM
        shape = tuple(np.ceil((self.surface.bounds[1] + NEAR_MM - low) / FINE_MM).astype(int) + 1)
        arguments = self.surface.vertices, self.surface.faces, low, shape, FINE_MM, NEAR_MM
        return clipped_distance_grid(*arguments), low

    def _voxels(self, volume: SampledVolume) -> tuple[Box, np.ndarray]:
        """The voxels of a volume in it and around it, and their places (nx, ny, nz, 3) [mm]."""
        linear, offset = volume.index_from_mm[:3, :3], volume.index_from_mm[:3, 3]
        corners = np.asarray(self.surface.vertices) @ linear.T + offset
        low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 1, 0, volume.shape)
        high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 2, 0, volume.shape)
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        index = np.moveaxis(np.indices(high - low), 0, -1) + low
        return box, (index - offset) @ np.linalg.inv(linear).T  # type: ignore[return-value]

    def replaced(self, volume: SampledVolume, value: np.ndarray) -> tuple[Box, np.ndarray]:
        """Voxels of a volume, and their values with another value in the crater, by the share of each
        voxel that is in it.
        """
        box, places = self._voxels(volume)
        fine, low = self._distances
        at = np.moveaxis((places - low) / FINE_MM, -1, 0)
        distance = map_coordinates(fine, at, order=1, mode="nearest")
        share = np.clip(0.5 - distance / volume.voxel_mm, 0, 1).astype(np.float32)
        before = volume.values(box)
        share = share.reshape(share.shape + (1,) * (before.ndim - 3))
        return box, before + share * (value - before)

    def without(self, volume: SampledVolume) -> tuple[Box, np.ndarray]:
        """Voxels of a volume of signed distances [mm], and these without the crater: negative in what
        remains.
        """
        box, places = self._voxels(volume)
        arguments = self.surface.vertices, self.surface.faces, places.reshape(-1, 3)
        distance = signed_distance(*arguments)[0].reshape(places.shape[:3])
        return box, np.maximum(volume.values(box), -distance)
