"""What the CT and its labels show at each pixel of an image plane: the truth that a B-mode image of a patient is compared with."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ultrasound.acoustics import KIDNEY
from ultrasound.probe import Probe
from ultrasound.scanner import ScannedAnatomy

# Surroundings are what is so near to the kidney; fat is of these HU; behind gas and bone nothing is to be seen.
NEAR_MM = 12.0
FAT_HU, GAS_HU, BONE_HU = (-150.0, -30.0), -300.0, 300.0
# Nearer to the array is its own ringing, deeper no longer the kidney.
DEPTHS_MM = (4.0, 45.0)
LESIONS = ("tumour", "cyst")


@dataclass(frozen=True)
class TruthVolumes:
    """On the CT's grid (nx, ny, nz): HU, whether a voxel is labelled as kidney, and distances from the kidney [mm]."""

    hu: np.ndarray
    kidney: np.ndarray
    outside_mm: np.ndarray
    index_from_mm: np.ndarray

    @classmethod
    def of(cls, anatomy: ScannedAnatomy) -> "TruthVolumes":
        """Return those of an anatomy with labels."""
        assert anatomy.labels is not None
        own = [value for value, tissue in anatomy.tissues.items() if tissue in (*KIDNEY, *LESIONS)]
        kidney = np.isin(anatomy.labels, own)
        outside = ndimage.distance_transform_edt(~kidney, sampling=anatomy.voxel_mm)
        return cls(anatomy.hu, kidney, outside, anatomy.index_from_mm)


@dataclass(frozen=True)
class PictureTruth:
    """Masks (rows, columns) of an image, all of pixels that the scanlines reach, at DEPTHS_MM, not behind gas or bone."""

    kidney: np.ndarray
    fat: np.ndarray
    surroundings: np.ndarray
    hu: np.ndarray
    """HU at every pixel."""
    is_kidney: np.ndarray
    """Whether any pixel, at whatever depth, is of the kidney."""


def picture_truth(
    volumes: TruthVolumes, probe: Probe, world_from_plane: np.ndarray, shape: tuple[int, int]
) -> PictureTruth:
    """Return the truth of an image of a shape (rows, columns) at a pose (4, 4)."""
    place = pixel_places(probe, shape)
    world = place @ world_from_plane[:3, :2].T + world_from_plane[:3, 3]
    at = np.moveaxis(world @ volumes.index_from_mm[:3, :3].T + volumes.index_from_mm[:3, 3], -1, 0)
    hu = ndimage.map_coordinates(volumes.hu, at, order=1, cval=-2000.0)
    kidney = ndimage.map_coordinates(volumes.kidney.astype(np.float32), at, order=1) > 0.5
    near = ndimage.map_coordinates(volumes.outside_mm, at, order=1, cval=1e3) <= NEAR_MM
    line, depth = probe.beam_coordinates(*np.moveaxis(place, -1, 0))
    seen = (line >= -0.5) & (line <= probe.number_of_scanlines - 0.5)
    seen &= (depth >= DEPTHS_MM[0]) & (depth <= DEPTHS_MM[1]) & ~_behind(hu, kidney, line, depth, probe)
    around = seen & near & ~kidney
    fat = around & (hu >= FAT_HU[0]) & (hu <= FAT_HU[1])
    return PictureTruth(seen & kidney, fat, around, hu, kidney)


def pixel_places(probe: Probe, shape: tuple[int, int]) -> np.ndarray:
    """Return places (rows, columns, 2) (u, v) [mm] of the centres of an image's pixels."""
    to_probe = probe.image_to_probe(*shape)
    u = np.arange(shape[1]) * to_probe[0, 0] + to_probe[0, 3]
    v = np.arange(shape[0]) * to_probe[1, 1] + to_probe[1, 3]
    return np.stack(np.meshgrid(u, v), axis=-1)


def _behind(
    hu: np.ndarray, kidney: np.ndarray, line: np.ndarray, depth: np.ndarray, probe: Probe
) -> np.ndarray:
    """Whether gas or bone, or the CT's border, is at a pixel (rows, columns) or in front of it, on its scanline or a neighbour."""
    hard = (hu < GAS_HU) | ((hu > BONE_HU) & ~kidney)
    first = np.full(probe.number_of_scanlines, np.inf)
    index = np.clip(np.rint(line), 0, probe.number_of_scanlines - 1).astype(int)
    within = hard & (depth >= 0)
    np.minimum.at(first, index[within], depth[within])
    return depth >= ndimage.minimum_filter1d(first, 5, mode="nearest")[index]
