"""Corrections of the tissue of single voxels, on a grid of their own."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import SimpleITK as sitk

from scenes.tissue_classes.tissue_map import TissueMap, codes_of_labels
from scenes.volumes.voxel_grid import VoxelGrid


def with_corrections(
    found: TissueMap, values: np.ndarray, index_from_mm: np.ndarray, tissues: Mapping[int, str]
) -> TissueMap:
    """Return a map with the tissues of ``values`` (nx, ny, nz), 0 where nothing is corrected, on the grid
    of ``index_from_mm`` (4, 4).
    """
    fine = VoxelGrid.of_transform(found.index_from_mm, found.codes.shape)
    codes = codes_of_labels(values, tissues).transpose(2, 1, 0)
    image = VoxelGrid.of_transform(index_from_mm, values.shape).image(np.ascontiguousarray(codes))
    there = fine.sampled(image, sitk.sitkNearestNeighbor, 0).transpose(2, 1, 0)
    drawn = found.drawn & (there == 0)
    return replace(found, codes=np.where(there > 0, there, found.codes), drawn=drawn)
