"""Pyramids and fascia as drawn: where they are, how many, and how much of the kidney they are."""

import numpy as np
import pytest
from scipy import ndimage

from scenes.tissue_classes.drawn_anatomy import (
    CORTEX_MM,
    LEAST_MM,
    MOST_MM,
    SHEETS_ABOVE,
    SHEETS_OVER_MM,
    draw_fascia,
    draw_perimysium,
    draw_pyramids,
)

SPACING = np.array([1.0, 1.1, 1.25])
SHAPE = (66, 52, 96)
AT = (np.moveaxis(np.indices(SHAPE), 0, -1) - (np.array(SHAPE) - 1) / 2) * SPACING
# Of an adult's kidney: 56 x 48 x 110 mm; the sinus opens to one side.
KIDNEY = np.linalg.norm(AT / [28.0, 24.0, 55.0], axis=-1) < 1
SINUS = KIDNEY & (np.linalg.norm((AT - [-12.0, 0.0, 0.0]) / [15.0, 8.0, 26.0], axis=-1) < 1)
PARENCHYMA = KIDNEY & ~SINUS
DEPTH = ndimage.distance_transform_edt(KIDNEY, sampling=SPACING).astype(np.float32)
FROM_SINUS = ndimage.distance_transform_edt(~SINUS, sampling=SPACING)


@pytest.fixture(scope="module")
def pyramids() -> np.ndarray:
    return draw_pyramids(PARENCHYMA, SINUS, DEPTH, SPACING)


def bodies(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Connected parts of at least 0.3 ml, and their sizes [ml]."""
    parts, count = ndimage.label(mask)
    ml = np.bincount(parts.ravel(), minlength=count + 1) * SPACING.prod() / 1000
    return parts, np.flatnonzero((ml >= 0.3) & (np.arange(count + 1) > 0))


def test_pyramids_are_in_the_parenchyma_below_its_cortex(pyramids):
    assert not (pyramids & ~PARENCHYMA).any()
    assert DEPTH[pyramids].min() >= CORTEX_MM and CORTEX_MM >= 5.0


def test_they_are_the_share_of_the_parenchyma_that_anatomy_has(pyramids):
    # Medulla is a fifth to a third of the parenchyma in volumetry.
    assert 0.10 < pyramids.sum() / PARENCHYMA.sum() < 0.35


def test_there_are_as_many_as_a_kidney_has_with_cortex_between_them(pyramids):
    """Parts that touch at their papillae, as compound ones do, are apart at their bases."""
    bases = pyramids & (DEPTH < CORTEX_MM + 3.0)
    assert 7 <= len(bodies(bases)[1]) <= 18
    # All layers of the outer medulla have columns.
    outer = PARENCHYMA & (DEPTH > CORTEX_MM) & (DEPTH < CORTEX_MM + 3.0)
    assert 0.05 < 1 - pyramids[outer].mean() < 0.8


def test_they_become_narrower_towards_the_sinus_and_reach_it(pyramids):
    parts, large = bodies(pyramids & (DEPTH < CORTEX_MM + 3.0))
    near = ndimage.binary_dilation(SINUS, iterations=3)
    reach = ndimage.label(pyramids)[0]
    reached = [np.isin(reach, np.unique(reach[parts == n])) & near for n in large]
    # Those of the poles, where the sinus is far, too.
    assert np.mean([pyramid.any() for pyramid in reached]) > 0.8
    # A cone's section falls from its base to its papilla; layers of equal distance to the sinus as a part of
    # the whole path.
    share = FROM_SINUS / (FROM_SINUS + DEPTH)
    inner, outer = (
        (share > low) & (share < low + 0.15) & PARENCHYMA & (DEPTH > CORTEX_MM) for low in (0.15, 0.55)
    )
    assert pyramids[inner].sum() < pyramids[outer].sum()


def test_a_kidney_whose_sinus_is_unknown_has_pyramids_too_and_a_thin_one_none():
    without = draw_pyramids(KIDNEY, np.zeros(SHAPE, bool), DEPTH, SPACING)
    assert 0.05 < without.sum() / KIDNEY.sum() < 0.45 and DEPTH[without].min() >= CORTEX_MM
    thin = KIDNEY & (DEPTH < CORTEX_MM - 1.0)
    assert not draw_pyramids(thin, np.zeros(SHAPE, bool), DEPTH * thin, SPACING).any()


@pytest.fixture(scope="module")
def fascia() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fascia and fat about a kidney that is 22 mm before a plane of muscle; and the distance to that plane
    [mm].
    """
    away = np.linalg.norm(AT / [12.0, 12.0, 30.0], axis=-1)
    kidney, muscle = away < 1, AT[..., 1] > 20.0
    distance = ndimage.distance_transform_edt(~kidney, sampling=SPACING)
    fat = ~(kidney | muscle)
    return draw_fascia(fat, muscle, distance, SPACING), fat, distance


def test_the_fascia_is_a_thin_sheet_in_fat_before_what_is_behind_it(fascia):
    sheet, fat, distance = fascia
    assert sheet.any() and not (sheet & ~fat).any()
    # Parallel to the plane, one voxel thick; a voxel is between the plane and the muscle's first voxel.
    off = 20.0 - AT[..., 1][sheet]
    assert np.ptp(off) <= SPACING[1] + 1e-6 and 1.0 < off.mean() < 5.0
    assert (sheet.sum(axis=1) <= 2).all()
    assert distance[sheet].min() > LEAST_MM and distance[sheet].max() < MOST_MM


def test_layers_of_muscle_are_thin_sheets_in_it():
    muscle = AT[..., 1] > 2.0
    sheets = draw_perimysium(muscle, SPACING)
    assert not (sheets & ~muscle).any() and 0.05 < sheets[muscle].mean() < 0.4
    assert (draw_perimysium(muscle, SPACING) == sheets).all()
    # Sheets are parallel to the muscle's surface: away from the border of the grid each is in few layers.
    layers = sheets[8:-8, :, 8:-8].mean(axis=(0, 2))
    assert (
        layers.max() > 4 * np.median(layers[AT[0, :, 0, 1] > 2.0])
        or (layers[AT[0, :, 0, 1] > 2.0] == 0).mean() > 0.3
    )


def test_sheets_in_muscle_are_broken_as_noise_smoothed_over_4_mm_is():
    """How often noise of a Gaussian correlation exp(-d^2 / (4 s^2)) crosses a level u: exp(-u^2 / 2) / (pi
    sqrt(2) s) (Rice 1945).
    """
    muscle = AT[..., 1] > 2.0
    sheets = draw_perimysium(muscle, SPACING)
    layer = sheets[:, sheets.sum(axis=(0, 2)).argmax()]
    crossings = np.count_nonzero(np.diff(layer, axis=1)) / (
        layer.shape[0] * (layer.shape[1] - 1) * SPACING[2]
    )
    # Noise has one value in a cell of about s, and is linear between: it crosses the level in fewer places,
    # and by chance.
    assert crossings == pytest.approx(
        np.exp(-(SHEETS_ABOVE**2) / 2) / (np.pi * np.sqrt(2) * SHEETS_OVER_MM / 2), rel=0.3
    )
