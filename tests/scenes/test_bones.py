"""Bones with their marrow, by HU and shape."""

from itertools import permutations

import numpy as np
import pytest
from scipy import ndimage

from scenes.tissue_classes.bones import _filled, bones

SPACING = np.array([0.9, 0.9, 0.9])
FAT, MARROW, SHELL, CORTEX, BLOOD = -100.0, 150.0, 600.0, 180.0, 200.0


def ball(centre_mm: tuple[float, float, float], radius_mm: float) -> np.ndarray:
    place = np.moveaxis(np.indices((80, 70, 60)), 0, -1) * SPACING - centre_mm
    return np.linalg.norm(place, axis=-1) <= radius_mm


def abdomen() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """HU of fat with a bone cut by the CT's border, a kidney and a vessel, all but the fat as bright as
    contrast agent makes them.
    """
    hu = np.full((80, 70, 60), FAT, np.float32)
    bone, kidney, vessel = (
        ball((0.0, 30.0, 27.0), 16.0),
        ball((50.0, 30.0, 27.0), 14.0),
        ball((30.0, 55.0, 27.0), 6.0),
    )
    hu[bone] = SHELL
    hu[ball((0.0, 30.0, 27.0), 14.0)] = MARROW
    hu[kidney], hu[vessel] = CORTEX, BLOOD
    return hu + np.random.default_rng(0).normal(0, 10, hu.shape).astype(np.float32), bone, kidney, vessel


def test_a_bone_is_filled_with_its_marrow_even_where_the_ct_ends_and_is_no_larger_than_it_is():
    hu, bone, _, _ = abdomen()
    found = bones(hu, SPACING)
    # Found in blocks of 1.8 mm: a rim of one of them may be missing or too much.
    assert (found & ball((0.0, 30.0, 27.0), 14.0)).sum() > 0.99 * ball((0.0, 30.0, 27.0), 14.0).sum()
    assert (
        not (found & ~ball((0.0, 30.0, 27.0), 16.0 + 2 * 1.8 * np.sqrt(3))).any()
        and (found & bone).sum() > 0.9 * bone.sum()
    )


@pytest.mark.parametrize("spacing", list(permutations((0.6, 0.9, 1.8))))
def test_a_bone_is_found_at_any_voxel_size(spacing):
    places = np.moveaxis(np.indices(np.ceil(60 / np.array(spacing)).astype(int)), 0, -1) * spacing
    away = np.linalg.norm(places - [24.0, 30.0, 35.0], axis=-1)
    found = bones(np.select([away < 14.0, away < 16.0], [MARROW, SHELL], FAT), np.array(spacing))
    # A rim of a block of 1.8 mm may be missing or too much, as above.
    assert found[away < 14.0].mean() > 0.99 and not found[away > 16.0 + 2 * 1.8 * np.sqrt(3)].any()


def test_a_bone_in_the_cts_corner_of_which_no_cut_shows_a_whole_ring_is_filled_too():
    hu = np.full((80, 70, 60), FAT, np.float32)
    hu[ball((0.0, 0.0, 0.0), 25.0)] = SHELL
    hu[ball((0.0, 0.0, 0.0), 22.0)] = MARROW
    found = bones(hu, SPACING)
    assert found[ball((0.0, 0.0, 0.0), 22.0)].mean() > 0.99
    assert not (found & ~ball((0.0, 0.0, 0.0), 25.0 + 2 * 1.8 * np.sqrt(3))).any()


@pytest.mark.parametrize("axis", range(3))
def test_a_pipe_of_bone_is_filled_though_both_its_ends_are_open(axis):
    places = np.moveaxis(np.indices((70, 70, 70)), 0, -1) * SPACING - 35 * SPACING
    across = np.linalg.norm(np.delete(places, axis, -1), axis=-1)
    within = np.abs(places[..., axis]) < 12.0
    hu = np.select([within & (across < 8.0), within & (across < 10.0)], [MARROW, SHELL], FAT)
    found = bones(hu, SPACING)
    assert found[within & (across < 8.0)].mean() > 0.99
    # Not what lies beside it: a rim of a block of 1.8 mm may be too much.
    assert not found[
        (across > 10.0 + 2 * 1.8 * np.sqrt(3)) | (np.abs(places[..., axis]) > 12.0 + 2 * 1.8 * np.sqrt(3))
    ].any()


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("axis", range(3))
def test_all_sections_are_filled_as_each_alone(axis, share):
    solid = np.random.default_rng(0).random((12, 15, 18)) < share
    each = [ndimage.binary_fill_holes(section) for section in np.moveaxis(solid, axis, 0)]
    assert np.array_equal(_filled(solid, axis), np.moveaxis(np.stack(each), 0, axis))


def test_what_is_bright_by_contrast_agent_is_no_bone():
    hu, _, kidney, vessel = abdomen()
    assert not (bones(hu, SPACING) & (kidney | vessel)).any()


def test_a_bright_speck_is_no_bone():
    hu = np.full((80, 70, 60), 40.0, np.float32)
    hu[ball((30.0, 30.0, 27.0), 3.0)] = 900.0
    assert not bones(hu, SPACING).any()
    hu[ball((30.0, 30.0, 27.0), 7.0)] = 900.0
    assert bones(hu, SPACING).any()
