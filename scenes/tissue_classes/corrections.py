"""Corrections of the tissue of single voxels, on a grid of their own."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import SimpleITK as sitk

from scenes.tissue_classes.tissue_map import TissueMap, codes_of_labels
from scenes.volumes.voxel_grid import VoxelGrid


def with_corrections(
    tissue_map: TissueMap, values: np.ndarray, index_from_mm: np.ndarray, tissues: Mapping[int, str]
) -> TissueMap:
    """A map with the tissues of ``values`` (nx, ny, nz), 0 where nothing is corrected, on the grid of
    ``index_from_mm`` (4, 4).
    """
    fine = VoxelGrid.of_transform(tissue_map.index_from_mm, tissue_map.codes.shape)
    codes = codes_of_labels(values, tissues).transpose(2, 1, 0)
    image = VoxelGrid.of_transform(index_from_mm, values.shape).image(np.ascontiguousarray(codes))
    there = fine.sampled(image, sitk.sitkNearestNeighbor, 0).transpose(2, 1, 0)
    drawn = tissue_map.drawn & (there == 0)
    return replace(tissue_map, codes=np.where(there > 0, there, tissue_map.codes), drawn=drawn)
