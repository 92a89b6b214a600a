"""Branches of the aorta in the arterial phase, and what has the HU of blood."""

import numpy as np
import pytest

from scenes.tissue_classes.vessels import (
    ABOVE_ORGAN_HU,
    AGENT_ABOVE_HU,
    BLOOD_ABOVE_HU,
    BRANCH_SHARE,
    RIM_ABOVE_HU,
    THIN_ABOVE_HU,
    blood,
    with_branches,
)

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


@pytest.mark.parametrize("has_organ", [False, True])
def test_blood_is_bright_in_the_mean_of_4_mm_at_the_rim_of_that_and_where_one_voxel_is_brighter(has_organ):
    """4 mm are 3.8, 3.1 and 0.9 voxels, rounded 4, 3 and 1, and the next odd numbers from these on 5, 3
    and 1, as windows by hand.
    """
    window, shape = (5, 3, 1), (24, 20, 12)
    hu = np.random.default_rng(3).normal(120.0, 30.0, shape)
    # A hundredth of the voxels has contrast agent.
    hu[np.random.default_rng(4).random(shape) < 0.01] = AGENT_ABOVE_HU + 1
    organ = np.zeros(shape, bool)
    organ[:, :9] = has_organ

    def windows(values: np.ndarray) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(values, window)

    # Each window takes its half from each border.
    once, twice = (slice(2, -2), slice(1, -1)), (slice(4, -4), slice(2, -2))
    mean, least = windows(hu).mean(axis=(3, 4, 5)), np.full(shape, BLOOD_ABOVE_HU)[once]
    if has_organ:
        least[organ[once]] = max(BLOOD_ABOVE_HU, np.median(hu[organ]) + ABOVE_ORGAN_HU)
    wide = mean > least
    beside = windows(wide).any(axis=(3, 4, 5))
    inner, within = hu[twice], organ[twice]
    expected = wide[once] | (beside & (inner > RIM_ABOVE_HU) & ~within) | (inner > THIN_ABOVE_HU)
    expected &= inner < AGENT_ABOVE_HU
    found = blood(hu, organ, np.array([1.05, 1.3, 4.5]))[twice]
    assert 0.2 < expected.mean() < 0.9
    np.testing.assert_array_equal(found, expected)
