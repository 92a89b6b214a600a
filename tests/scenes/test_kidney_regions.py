"""How much a region of a CT is like a kidney: boxes of voxels with sides of known HU."""

import numpy as np
import pytest

from scenes.patients.kidney_regions import EDGE_SHARE, FAT_HU, LEAST_EDGE, Region

KIDNEY_HU = 150.0
CONTRAST = KIDNEY_HU - FAT_HU
BOX = slice(8, 24), slice(10, 22), slice(10, 22)


def region(beside_hu, cut=None):
    """A box in fat, with other tissue at its side of higher x."""
    hounsfield = np.full((32, 32, 32), FAT_HU)
    hounsfield[:, :, 22:] = beside_hu
    hounsfield[BOX] = KIDNEY_HU
    inside = hounsfield == KIDNEY_HU
    if cut is not None:
        inside[cut] = False
    return Region.of(inside, hounsfield)


@pytest.mark.parametrize("sign", [-1, 1])
def test_an_edge_is_a_change_by_a_share_of_the_contrast_to_fat(sign):
    assert region(KIDNEY_HU + sign * 1.01 * EDGE_SHARE * CONTRAST).edge == 1
    touching = region(KIDNEY_HU + sign * 0.99 * EDGE_SHARE * CONTRAST)
    # One of six sides, 16 x 12 of 1056 voxel faces, and where its shell is rounded some more of its
    # neighbours'.
    assert 192 / 1056 <= 1 - touching.edge < 1.5 * 192 / 1056
    assert touching.edge < LEAST_EDGE and not touching.is_kidney
    x, y, z = touching.open_side
    assert x > 6 and abs(y) < 0.5 and abs(z) < 0.5


def test_a_hollow_leaves_the_hull_unfilled():
    whole, hollow = region(FAT_HU), region(FAT_HU, (slice(12, 20), slice(10, 18), slice(10, 22)))
    assert whole.solidity == pytest.approx(1, abs=0.03)
    assert hollow.solidity == pytest.approx(1 - 8 * 8 / (16 * 12), abs=0.03)


def test_what_touches_the_border_is_not_whole_and_ranks_below_what_is():
    hounsfield = np.full((32, 32, 32), FAT_HU)
    hounsfield[:24, 10:22, 10:22] = KIDNEY_HU
    cut = Region.of(hounsfield == KIDNEY_HU, hounsfield)
    assert cut.is_kidney and not cut.is_whole and cut.rank < region(FAT_HU).rank


def test_one_like_a_kidney_ranks_above_one_with_a_better_sum():
    """An edge nearly everywhere does not outweigh a shape that is none of a kidney."""
    kidney = Region(np.ones((1, 1, 1), bool), 0.86, 0.66, np.zeros(3), True)
    other = Region(np.ones((1, 1, 1), bool), 1.0, 0.64, np.zeros(3), True)
    assert kidney.is_kidney and not other.is_kidney and kidney.rank > other.rank


def test_deepest_voxel():
    assert abs(region(FAT_HU).deepest() - [15.5, 15.5, 15.5]).max() <= 2.5
