"""Dense pieces in a kidney: contrast agent or stone, by phase, size and connection."""

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scenes.tissue_classes.collecting_system import (
    BESIDE_ABOVE_HU,
    DENSE_ABOVE_HU,
    LARGEST_STONE_ML,
    LEAST_PELVIS_ML,
    LEAST_SHARE,
    PELVIS_MM,
    SMALL_ML,
    DensePieces,
    agent_in_bone,
    dense_pieces,
    pelvis_without_agent,
)

SHAPE, VOXEL_ML = (60, 50, 40), 0.001
PLAIN, ENHANCED = 35.0, 180.0
AT = np.moveaxis(np.indices(SHAPE), 0, -1).astype(float)
MIDDLE = np.array([30.0, 25.0, 20.0])


def box(*sides: tuple[int, int]) -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    mask[tuple(slice(*side) for side in sides)] = True
    return mask


# The kidney, x from 10 to 50, with a hollow beyond x = 40.
KIDNEY, PARENCHYMA = box((10, 50), (5, 45), (5, 35)), box((10, 40), (5, 45), (5, 35))


def pieces(hu: np.ndarray, parenchyma=PARENCHYMA, kidney=KIDNEY, voxel_ml=VOXEL_ML) -> DensePieces:
    return dense_pieces(hu.astype(np.float32), parenchyma, kidney, voxel_ml)


def kidney_of(level: float, piece: np.ndarray, above: float) -> np.ndarray:
    """HU of a kidney in fat with a piece that is brighter than its parenchyma by some HU."""
    return np.where(piece, level + above, np.where(KIDNEY, level, -90.0))


@pytest.mark.parametrize("level, is_enhanced", [(PLAIN, False), (ENHANCED, True)])
def test_a_small_dense_piece_is_a_stone_without_contrast_agent_and_contrast_agent_with_it(level, is_enhanced):
    piece = box((28, 31), (20, 23), (18, 21))
    found = pieces(kidney_of(level, piece, 400.0))
    assert found.is_enhanced == is_enhanced
    one, other = (found.urine, found.stone) if is_enhanced else (found.stone, found.urine)
    assert (one == piece).all() and not other.any()


@pytest.mark.parametrize("more, is_stone", [(-1, True), (1, False)])
def test_without_contrast_agent_in_the_parenchyma_a_large_piece_is_contrast_agent_too(more, is_stone):
    count = round(LARGEST_STONE_ML / VOXEL_ML)
    piece = np.zeros(SHAPE, bool)
    inner = np.argwhere(box((12, 32), (8, 28), (8, 28)))
    piece[tuple(inner[: count + more].T)] = True
    found = pieces(kidney_of(PLAIN, piece, 500.0))
    assert (found.stone == (piece & is_stone)).all() and (found.urine == (piece & (not is_stone))).all()
    # Of one that continues outside, what is in the kidney counts: 2.4 of 5.6 ml.
    half = box((44, 58), (8, 28), (10, 30))
    assert (pieces(kidney_of(PLAIN, half, 500.0)).stone == half).all()
    # Of voxels twice as large the same piece is larger.
    assert not pieces(kidney_of(PLAIN, piece, 500.0), voxel_ml=2 * VOXEL_ML).stone.any()


@pytest.mark.parametrize("level", [PLAIN, ENHANCED])
def test_what_is_dense_by_one_hu_too_little_is_parenchyma(level):
    piece = box((28, 34), (20, 24), (18, 22))
    for off, count in ((1.0, piece.sum()), (-1.0, 0)):
        found = pieces(kidney_of(level, piece, DENSE_ABOVE_HU + off))
        assert (found.urine | found.stone).sum() == count


def test_the_enhanced_phase_begins_between_plain_and_enhanced_parenchyma_whatever_is_dense_in_it():
    # Without contrast agent parenchyma has 30 to 50 HU, with it more than 100, though a sixth of it be a
    # dense piece.
    piece = box((12, 22), (8, 28), (8, 28))
    assert piece.sum() / PARENCHYMA.sum() > 0.1
    assert not any(pieces(kidney_of(level, piece, 600.0)).is_enhanced for level in (20.0, 50.0, 60.0))
    assert all(pieces(kidney_of(level, piece, 600.0)).is_enhanced for level in (100.0, 250.0))


@pytest.mark.parametrize("level, kind", [(PLAIN, "stone"), (ENHANCED, "urine")])
@pytest.mark.parametrize("turn", list(permutations(range(3)))[:4])
def test_a_piece_belongs_to_a_kidney_that_holds_enough_of_it_and_continues_outside(level, kind, turn):
    """A rod that begins in the hollow and leaves it: with a larger share inside it is the pelvis and
    ureter, with a smaller one a bone beside.
    """
    for inside, is_own in ((round(10 * LEAST_SHARE) + 1, True), (round(10 * LEAST_SHARE) - 1, False)):
        piece = box((50 - inside, 60 - inside), (24, 27), (18, 21))
        hu = kidney_of(level, piece, 300.0)
        given = (each.transpose(turn) for each in (hu, PARENCHYMA, KIDNEY))
        # Of voxels so large that the rod is no small piece.
        found = pieces(*given, voxel_ml=1.1 * SMALL_ML / piece.sum())
        one = found.urine | found.stone if kind == "stone" else found.urine
        assert (one == (piece & is_own).transpose(turn)).all()


@pytest.mark.parametrize("times, is_own", [(0.9, True), (1.1, False)])
def test_contrast_agent_in_a_small_piece_only_begins_in_the_kidney(times, is_own):
    piece = box((49, 59), (24, 27), (18, 21))
    hu, voxel_ml = kidney_of(ENHANCED, piece, 300.0), times * SMALL_ML / piece.sum()
    assert (pieces(hu, voxel_ml=voxel_ml).urine == (piece & is_own)).all()
    # A rib beside an unenhanced kidney is no stone.
    assert not pieces(kidney_of(PLAIN, piece, 300.0), voxel_ml=voxel_ml).stone.any()


@pytest.mark.parametrize("level, urine", [(PLAIN, 12.0), (ENHANCED, 8.0)])
def test_a_dilated_pelvis_without_contrast_agent_is_fluid_and_a_narrow_one_is_not_seen(level, urine):
    outer = np.where(KIDNEY, -1.0, 1.0 + np.abs(AT[..., 0] - 50))
    for radius, is_seen in ((8.0, True), (PELVIS_MM - 1.5, False)):
        away = np.linalg.norm(AT - [50.0, 25.0, 20.0], axis=-1)
        pelvis = (away <= radius) & ~PARENCHYMA
        hu = np.where(pelvis, urine, np.where(PARENCHYMA, level, -90.0)).astype(np.float32)
        found = pelvis_without_agent(hu, PARENCHYMA, PARENCHYMA, outer, np.ones(3))
        assert not (found & ~pelvis).any()
        # Cells of 2 mm leave up to one of them out at the rim.
        assert (found.sum() > 0.7 * pelvis.sum()) if is_seen else not found.any()
    # Blood and bowel beside it are no urine, nor is what does not reach the hollow.
    assert not pelvis_without_agent(hu + 60, PARENCHYMA, PARENCHYMA, outer, np.ones(3)).any()
    assert not pelvis_without_agent(hu, PARENCHYMA, PARENCHYMA, np.maximum(outer, 0.5), np.ones(3)).any()


@pytest.mark.parametrize(
    "level, urine, is_seen",
    [
        (40.0, 14.0, True),
        (40.0, 12.0, False),
        (40.0, 31.5, True),
        (40.0, 32.5, False),
        (ENHANCED, -9.0, True),
        (ENHANCED, -11.0, False),
        (ENHANCED, 34.5, True),
        (ENHANCED, 35.5, False),
    ],
)
def test_urine_is_8_to_27_hu_darker_than_plain_parenchyma_and_minus_10_to_35_hu_beside_enhanced(
    level, urine, is_seen
):
    pelvis = (np.linalg.norm(AT - [50.0, 25.0, 20.0], axis=-1) <= 8.0) & ~PARENCHYMA
    hu = np.where(pelvis, urine, np.where(PARENCHYMA, level, -90.0)).astype(np.float32)
    outer = np.where(KIDNEY, -1.0, 1.0 + np.abs(AT[..., 0] - 50))
    assert pelvis_without_agent(hu, PARENCHYMA, PARENCHYMA, outer, np.ones(3)).any() == is_seen


@pytest.mark.parametrize(("radius", "is_seen"), [(6.15, False), (6.7, True)])
def test_a_pelvis_is_seen_from_a_volume_on(radius, is_seen):
    """A ball in voxels that differ along each axis, each a cell of its own, so that distances are those of
    the voxels' centres.
    """
    spacing = np.array([1.4, 1.5, 1.7])
    places = AT * spacing
    pelvis = np.linalg.norm(places - MIDDLE * spacing, axis=-1) <= radius
    core = cKDTree(places[~pelvis]).query(places[pelvis])[0] >= PELVIS_MM
    near = cKDTree(places[pelvis][core]).query(places[pelvis])[0] <= PELVIS_MM
    # The ball that is sought fits into both; one has up to a fifth less than the least volume, the other
    # more.
    volume_ml = near.sum() * spacing.prod() / 1000
    assert (
        core.any() and abs(volume_ml / LEAST_PELVIS_ML - 1) < 0.2 and (volume_ml > LEAST_PELVIS_ML) == is_seen
    )
    hu = np.where(pelvis, 10.0, np.where(PARENCHYMA, ENHANCED, -90.0)).astype(np.float32)
    parenchyma, outer = PARENCHYMA & ~pelvis, (AT[..., 0] - 30.0) * spacing[0]
    found = pelvis_without_agent(hu, parenchyma, parenchyma, outer, spacing)
    assert found.sum() == near.sum() * is_seen


def test_a_dense_piece_outside_a_kidney_is_none_of_its():
    for level in (PLAIN, ENHANCED):
        found = pieces(kidney_of(level, box((52, 58), (20, 26), (18, 24)), 700.0))
        assert not found.urine.any() and not found.stone.any()


def test_pieces_that_touch_by_a_corner_are_one():
    inner, outer = box((45, 50), (20, 25), (15, 20)), box((50, 54), (25, 29), (20, 24))
    found = pieces(kidney_of(ENHANCED, inner | outer, 300.0))
    assert (found.urine == (inner | outer)).all()


@pytest.mark.parametrize("off, is_urine", [(1.0, True), (-1.0, False)])
def test_voxels_beside_contrast_agent_are_it_by_partial_volume_within_the_kidney(off, is_urine):
    agent = box((26, 32), (20, 26), (17, 23))
    rim = box((25, 33), (19, 27), (16, 24)) & ~agent
    hu = kidney_of(ENHANCED, agent, 400.0)
    hu[rim] = ENHANCED + BESIDE_ABOVE_HU + off
    far = box((15, 17), (20, 22), (17, 19))
    hu[far] = ENHANCED + BESIDE_ABOVE_HU + off
    found = pieces(hu)
    assert (found.urine == (agent | rim if is_urine else agent)).all()
    # About a stone nothing is added.
    stone = pieces(np.where(far, PLAIN, hu - ENHANCED + PLAIN))
    assert (stone.stone == agent).all() and not stone.urine.any()


def test_without_parenchyma_nothing_breaks():
    found = pieces(
        kidney_of(PLAIN, box((1, 2), (1, 2), (1, 2)), 0.0), np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    )
    assert not (found.urine.any() or found.stone.any() or found.is_enhanced)


def test_a_piece_of_bone_that_contains_contrast_agent_is_none_but_a_bone_beside_it_stays():
    spine, rest = box((0, 20), (0, 20), (0, 20)), box((30, 36), (5, 11), (5, 11))
    # The agent reaches into a corner of the spine, as where small gaps between both were closed.
    urine = box((31, 35), (6, 10), (6, 10)) | box((18, 22), (18, 22), (18, 22))
    found = agent_in_bone(spine | rest, urine)
    assert (found == rest).all()
