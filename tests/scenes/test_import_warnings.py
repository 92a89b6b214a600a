"""Import warnings: the brightness that the B-mode image takes for stone. The other warnings: test_patient_import.py."""

import numpy as np
import pytest
import SimpleITK as sitk
from scipy import ndimage

from scenes.patients.import_warnings import STONE_ABOVE_MEDIAN_HU, stone_warnings
from scenes.volumes.voxel_grid import VoxelGrid

KIDNEY_HU, WHOLE, NOWHERE = 100.0, np.ones((10, 10, 10), bool), np.zeros((10, 10, 10), bool)


@pytest.fixture
def grid() -> VoxelGrid:
    """Voxels of 2 mm, each 0.008 ml."""
    image = sitk.Image([10, 10, 10], sitk.sitkUInt8)
    image.SetSpacing((2.0, 2.0, 2.0))
    return VoxelGrid.of(image)


@pytest.mark.parametrize(("above", "edge", "lines"), [(0, 3, 0), (1, 3, 1), (1, 2, 0)])
def test_as_bright_as_stone_is_what_the_echo_takes_for_one_and_no_speck(grid, above, edge, lines):
    hounsfield = np.full((10, 10, 10), KIDNEY_HU)
    hounsfield[2:][:edge, :edge, :edge] = KIDNEY_HU + STONE_ABOVE_MEDIAN_HU + above
    found = stone_warnings(grid, hounsfield, WHOLE, NOWHERE)
    assert len(found) == lines
    for line in found:
        assert "0.2 ml inside the organ (2.7% of it)" in line
        # The voxels 0 to 2 along x and y, 2 to 4 along z.
        assert "the largest piece 0.2 ml in the middle third, at 2, 2, 6 mm (LPS)" in line


def test_the_rim_of_urine_is_bright_where_voxels_are_cut(grid):
    urine = NOWHERE.copy()
    urine[4, 4, 2:8] = True
    hounsfield = np.where(ndimage.binary_dilation(urine), 400.0, KIDNEY_HU)
    assert stone_warnings(grid, hounsfield, ~urine, urine) == ()
    assert len(stone_warnings(grid, hounsfield, ~urine, NOWHERE)) == 1
