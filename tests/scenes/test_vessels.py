"""Branches of the aorta in the arterial phase."""

import numpy as np

from scenes.tissue_classes.vessels import BRANCH_SHARE, with_branches

AORTA_HU = 400.0


def box(*sides: tuple[int, int]) -> np.ndarray:
    mask = np.zeros((30, 30, 20), bool)
    mask[tuple(slice(*side) for side in sides)] = True
    return mask


AORTA, BRANCH = box((10, 16), (10, 16), (0, 20)), box((16, 24), (12, 14), (9, 11))


def test_a_branch_is_connected_to_the_aorta_and_nearly_as_bright():
    apart = box((26, 29), (2, 6), (5, 9))
    for off, expected in ((1.0, AORTA | BRANCH), (-1.0, AORTA)):
        hu = np.where(AORTA, AORTA_HU, 40.0)
        hu[BRANCH | apart] = BRANCH_SHARE * AORTA_HU + off
        assert (with_branches(hu, AORTA, np.zeros_like(AORTA)) == expected).all()


def test_bone_and_kidney_that_it_touches_are_no_branch():
    hu = np.where(AORTA | BRANCH, AORTA_HU, 40.0)
    assert (with_branches(hu, AORTA, BRANCH) == AORTA).all()


def test_without_an_aorta_there_is_no_branch():
    hu = np.full(AORTA.shape, AORTA_HU)
    assert not with_branches(hu, np.zeros_like(AORTA), np.zeros_like(AORTA)).any()
