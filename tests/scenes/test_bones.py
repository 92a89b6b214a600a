"""Tissues that no label tells: bone with its marrow, blood with contrast agent."""

from itertools import permutations

import numpy as np
import pytest
from scipy import ndimage

from scenes.patients import import_warnings
from ultrasound.acoustics import (
    ATTENUATION,
    IMPEDANCE,
    STONE_ABOVE_MEDIAN_HU,
    _filled,
    bones,
    classify_tissues,
    enclosed,
    properties,
    tissue_table,
)

SPACING = np.array([0.9, 0.9, 0.9])
FAT, MARROW, SHELL, CORTEX, BLOOD = -100.0, 150.0, 600.0, 180.0, 200.0


def ball(centre_mm: tuple[float, float, float], radius_mm: float) -> np.ndarray:
    place = np.moveaxis(np.indices((80, 70, 60)), 0, -1) * SPACING - centre_mm
    return np.linalg.norm(place, axis=-1) <= radius_mm


def abdomen() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """HU of fat with a bone cut by the CT's border, a kidney and a vessel, all but the fat as bright as contrast agent makes them."""
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


def test_what_has_a_label_is_no_bone():
    hu, bone, kidney, _ = abdomen()
    muscle = bone & (np.arange(70)[:, None] < 34)
    found = classify_tissues(hu, {"kidney": kidney, "muscle": muscle}, SPACING)["bone"]
    assert not (found & muscle).any() and found[bone & ~muscle].mean() > 0.9


@pytest.mark.parametrize("across, down", list(permutations(range(3), 2)))
@pytest.mark.parametrize("width, closed", [(17.0, True), (23.0, False)])
def test_a_groove_is_a_hollow_where_no_ball_of_20_mm_goes_in(across, down, width, closed):
    spacing = np.array([1.0, 2.0, 0.5])
    places = np.moveaxis(np.indices((60 / spacing).astype(int) + 1), 0, -1) * spacing - 30.0
    groove = (np.abs(places[..., across]) < width / 2) & (places[..., down] > -20.0)
    found = enclosed(~groove, spacing)
    assert not (found & ~groove).any()
    # Amid the groove: at a width of 17 mm a ball on its open end reaches 5 mm in, and where one goes in it touches the walls.
    along = np.delete(places, [across, down], -1)[..., 0]
    deep = (np.abs(places[..., across]) < width / 2 - 2.0) & (np.abs(along) < 5.0)
    deep &= (places[..., down] > -5.0) & (places[..., down] < 20.0)
    assert found[deep].all() if closed else not found[deep].any()


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


def test_what_is_bright_by_contrast_agent_is_no_bone_and_outside_the_labels_blood():
    hu, bone, kidney, vessel = abdomen()
    found = classify_tissues(hu, {"kidney": kidney}, SPACING)
    assert not (found["bone"] & (kidney | vessel)).any()
    assert (found["vessel"] & vessel).sum() > 0.6 * vessel.sum()
    assert not (found["vessel"] & (kidney | bone)).any()


def test_without_contrast_agent_nothing_is_taken_for_blood():
    hu, _, kidney, _ = abdomen()
    hu[kidney] -= CORTEX - 30.0
    assert "vessel" not in classify_tissues(hu, {"kidney": kidney}, SPACING)


def test_contrast_agent_in_labelled_urine_and_about_it_is_no_stone_but_without_agent_what_is_bright_there_is():
    hu, _, kidney, _ = abdomen()
    urine, agent = ball((50.0, 30.0, 27.0), 4.0), ball((50.0, 30.0, 27.0), 4.5)
    hu[agent] = CORTEX + STONE_ABOVE_MEDIAN_HU + 100.0
    named = {"kidney": kidney & ~urine, "urine": urine}
    assert not classify_tissues(hu, named, SPACING)["stone"].any()
    assert (classify_tissues(hu, {"kidney": kidney}, SPACING)["stone"] == agent).all()
    assert (classify_tissues(hu - CORTEX + 30.0, named, SPACING)["stone"] == agent).all()


def test_an_import_warns_of_what_is_classified_as_stone():
    assert import_warnings.STONE_ABOVE_MEDIAN_HU == STONE_ABOVE_MEDIAN_HU


def test_a_bright_speck_is_no_bone():
    hu = np.full((80, 70, 60), 40.0, np.float32)
    hu[ball((30.0, 30.0, 27.0), 3.0)] = 900.0
    assert not bones(hu, SPACING).any()
    hu[ball((30.0, 30.0, 27.0), 7.0)] = 900.0
    assert bones(hu, SPACING).any()


def test_marrow_takes_the_sound_that_bone_takes():
    hu, _, _, _ = abdomen()
    values = properties(hu, spacing_mm=SPACING)[4, 33, 30]
    table = tissue_table()["bone"]
    assert abs(values[IMPEDANCE] - table["impedance_mrayl"]) < 0.01
    assert abs(values[ATTENUATION] - table["attenuation_db_cm_mhz"]) < 0.01
