"""Parts of a kidney by HU: cortex and medulla where the phase shows them, sinus and vessels of the hollow."""

import numpy as np
import pytest
from scipy import ndimage

from scenes.tissue_classes.kidney_parts import (
    CORTEX_ABOVE_MEDULLA_HU,
    ENHANCED_VESSEL_SHARE,
    FAT_BELOW_HU,
    SINUS_SHARE,
    VESSEL_AGAINST_MEDIAN_HU,
    cortex_and_medulla_hu,
    kidney_parts,
)

SPACING, SHAPE = np.array([1.0, 1.2, 1.5]), (70, 50, 80)
AT = (np.moveaxis(np.indices(SHAPE), 0, -1) - (np.array(SHAPE) - 1) / 2) * SPACING
HALF_AXES = np.array([28.0, 22.0, 50.0])
CORTEX_HU, FAT_HU = 190.0, -90.0
# A cavity for the sinus.
HOLLOW = np.linalg.norm(AT / [9.0, 7.0, 22.0], axis=-1) < 1
KIDNEY = np.linalg.norm(AT / HALF_AXES, axis=-1) < 1
PARENCHYMA = KIDNEY & ~HOLLOW
DEPTH = ndimage.distance_transform_edt(KIDNEY, sampling=SPACING)


def pyramids() -> np.ndarray:
    """Pyramids in three rows of five around the sinus, 7 mm below the surface, with 4 mm of cortex between
    them; a fifth of the parenchyma.
    """
    column = np.abs((AT[..., 2] + 9.0) % 18.0 - 9.0) > 7.0
    angle = np.arctan2(AT[..., 1], AT[..., 0])
    across = np.hypot(AT[..., 0], AT[..., 1]) * np.abs((angle + np.pi / 5) % (2 * np.pi / 5) - np.pi / 5)
    between = np.hypot(AT[..., 0], AT[..., 1]) * np.pi / 5 - across < 2.0
    return PARENCHYMA & (DEPTH > 7.0) & ~column & ~between


MEDULLA = pyramids()


def made(medulla_hu: float, noise: float = 0.0, cortex_hu: float = CORTEX_HU) -> np.ndarray:
    """HU of a kidney with pyramids, blurred as by a CT of 1 mm, with what noise is left after smoothing."""
    hu = np.where(MEDULLA, medulla_hu, np.where(KIDNEY, cortex_hu, FAT_HU))
    hu = ndimage.gaussian_filter(np.where(HOLLOW, FAT_HU, hu).astype(np.float32), 0.5 / SPACING)
    return hu + np.random.default_rng(2).normal(0, noise, SHAPE).astype(np.float32)


def parts_of(
    hu: np.ndarray, parenchyma: np.ndarray = PARENCHYMA, hollow: np.ndarray = HOLLOW
) -> dict[str, np.ndarray]:
    return kidney_parts(hu, parenchyma, hollow, DEPTH)


def dice(one: np.ndarray, other: np.ndarray) -> float:
    return 2 * (one & other).sum() / (one.sum() + other.sum())


@pytest.mark.parametrize("cortex_hu, medulla_hu", [(190.0, 90.0), (160.0, 100.0), (230.0, 80.0)])
def test_cortex_and_medulla_are_told_apart_in_the_corticomedullary_phase(cortex_hu, medulla_hu):
    parts = parts_of(made(medulla_hu, 8.0, cortex_hu))
    # Pyramids 14 mm wide and 9 mm high, whose borders are right to half a voxel on each side: (1 - 1 / 14)^2
    # (1 - 1 / 9) of their volume.
    assert dice(parts["medulla"], MEDULLA) > 0.85
    assert dice(parts["cortex"], PARENCHYMA & ~MEDULLA) > 0.95
    assert "kidney" not in parts


def test_a_calyx_without_contrast_agent_is_no_medulla():
    calyx = PARENCHYMA & (DEPTH > 14.0) & (np.linalg.norm(AT - [9.0, 0.0, 0.0], axis=-1) < 5.0)
    parts = parts_of(np.where(calyx, 8.0, made(80.0)))
    assert parts["sinus"][calyx].all() and calyx.sum() > 50
    assert dice(parts["medulla"], MEDULLA & ~calyx) > 0.85


@pytest.mark.parametrize("phase, hu", [("nephrographic", 180.0), ("portal", 165.0)])
def test_of_the_nephrographic_phase_parenchyma_stays_whole(phase, hu):
    parts = parts_of(made(hu, 8.0))
    assert "medulla" not in parts and "cortex" not in parts
    assert dice(parts["kidney"], PARENCHYMA) > 0.97


def test_of_the_unenhanced_phase_parenchyma_stays_whole_though_it_be_uneven():
    hu = made(10.0, 4.0, cortex_hu=60.0)
    parts = parts_of(hu)
    assert not {"cortex", "medulla"} & set(parts) and dice(parts["kidney"], PARENCHYMA) > 0.97


def test_the_levels_of_cortex_and_medulla_are_found_where_urine_and_fat_are_among_them():
    """Of the inner parenchyma here more than half is pyramid, so that its lower quartile is medulla."""
    rng = np.random.default_rng(3)
    depth = rng.uniform(0, 16, 40_000)
    for cortex, medulla in ((200.0, 70.0), (170.0, 120.0)):
        inner = (depth > 8.0) & (rng.random(len(depth)) < 0.7)
        hu = np.where(inner, medulla, cortex) + rng.normal(0, 3, len(depth))
        hu[(depth > 12.0) & (rng.random(len(depth)) < 0.4)] = rng.choice([8.0, -90.0])
        levels = cortex_and_medulla_hu(hu, np.ones(len(depth), bool), depth)
        # The lower quartile of noise of 3 HU is at most 2.1 HU below its median.
        assert levels == pytest.approx((cortex, medulla), abs=2.2)


@pytest.mark.parametrize("off, tells", [(3.0, True), (-3.0, False)])
def test_less_contrast_than_the_corticomedullary_phase_has_tells_nothing_apart(off, tells):
    depth = np.linspace(0, 16, 20_000)
    hu = np.where(depth > 8.0, 180.0 - CORTEX_ABOVE_MEDULLA_HU - off, 180.0)
    assert (cortex_and_medulla_hu(hu, np.ones(len(depth), bool), depth) is not None) == tells


def test_a_shell_without_an_inner_part_has_no_border():
    depth = np.linspace(0, 7, 20_000)
    assert cortex_and_medulla_hu(np.where(depth > 5, 80.0, 200.0), np.ones(len(depth), bool), depth) is None


def test_cortex_over_the_pyramids_stays_though_noise_is_dark():
    parts = parts_of(made(90.0, 25.0))
    assert not parts["medulla"][DEPTH < 2.0].any()
    # Single dark voxels are no medulla: of the outer 4 mm, which has none, 2 % at most.
    assert parts["medulla"][PARENCHYMA & (DEPTH < 4.0)].mean() < 0.02


@pytest.mark.parametrize("level", [35.0, 180.0])
def test_fat_in_the_hollow_and_deep_in_the_parenchyma_is_sinus_and_partial_volume_at_the_surface_is_not(
    level,
):
    hu = np.where(PARENCHYMA, level, FAT_HU)
    lobule = PARENCHYMA & (np.linalg.norm(AT - [14.0, 0.0, 0.0], axis=-1) < 3.0)
    rim = PARENCHYMA & (DEPTH < 2.5)
    hu[lobule | rim] = FAT_BELOW_HU - 1
    parts = parts_of(hu)
    assert (parts["sinus"] == (HOLLOW | lobule)).all()
    assert (parts["kidney"] == (PARENCHYMA & ~lobule)).all()
    hu[lobule] = FAT_BELOW_HU + 1
    if level < 100:
        assert not parts_of(hu)["sinus"][lobule].any()


@pytest.mark.parametrize("off, is_sinus", [(-1.0, True), (1.0, False)])
def test_what_takes_up_no_contrast_agent_deep_in_a_kidney_is_no_parenchyma(off, is_sinus):
    calyx = PARENCHYMA & (np.linalg.norm(AT - [14.0, 0.0, 0.0], axis=-1) < 3.0)
    hu = np.where(PARENCHYMA, 180.0, FAT_HU)
    hu[calyx] = SINUS_SHARE * 180.0 + off
    assert (parts_of(hu)["sinus"] == (HOLLOW | calyx if is_sinus else HOLLOW)).all()


@pytest.mark.parametrize(
    "level, border", [(35.0, 35.0 + VESSEL_AGAINST_MEDIAN_HU[0]), (180.0, ENHANCED_VESSEL_SHARE * 180.0)]
)
def test_in_the_hollow_what_is_as_bright_as_blood_is_a_vessel(level, border):
    vessel = HOLLOW & (np.hypot(AT[..., 0], AT[..., 1]) < 3.0)
    hu = np.where(PARENCHYMA, level, FAT_HU)
    hu[vessel] = border + 1
    parts = parts_of(hu)
    assert (parts["vessel"] == vessel).all() and (parts["sinus"] == (HOLLOW & ~vessel)).all()
    hu[vessel] = border - 1
    assert not parts_of(hu)["vessel"].any()


def test_without_contrast_agent_what_is_brighter_than_blood_in_the_hollow_is_no_vessel():
    blur = HOLLOW & (np.hypot(AT[..., 0], AT[..., 1]) < 3.0)
    for off, is_vessel in ((-1, True), (1, False)):
        hu = np.where(PARENCHYMA, 35.0, FAT_HU)
        hu[blur] = 35.0 + VESSEL_AGAINST_MEDIAN_HU[1] + off
        assert parts_of(hu)["vessel"].any() == is_vessel


@pytest.mark.parametrize("medulla_hu", [90.0, 180.0])
def test_parts_are_apart_and_all_of_the_kidney(medulla_hu):
    parts = parts_of(made(medulla_hu, 10.0))
    assert (sum(mask.astype(int) for mask in parts.values()) == KIDNEY).all()
