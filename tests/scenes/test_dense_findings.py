"""What an import says of contrast agent and stones, against what the tissue map shows of the same
patients.
"""

import re
from functools import cache

import numpy as np
import pytest
import trimesh
from synthetic_body import LEFT, ellipsoid, grid_around, level, points_of

from scenes.patients.dense_findings import dense_findings
from scenes.tissue_classes.collecting_system import DENSE_ABOVE_HU, LARGEST_STONE_ML
from scenes.tissue_classes.kidney_parts import ENHANCED_FROM_HU
from scenes.tissue_classes.tissue_map import TissueMap, codes_of_labels, tissue_map
from scenes.volumes.voxel_grid import VoxelGrid

FAT_HU, ENHANCED_HU, UNENHANCED_HU, BRIGHT_HU = -100.0, 150.0, 35.0, 600.0
KIDNEY = LEFT[0], np.array([22.0, 18.0, 32.0])
SMALL = LEFT[0] + [0, 0, 15], np.full(3, 5.0)
LARGE = LEFT[0], np.full(3, 10.0)
# Half of it is outside the kidney, as a pelvis is that continues as ureter.
PELVIS = LEFT[0] - [22.0, 0, 0], np.array([11.0, 6.0, 9.0])
LABELLED = LEFT[0] - [0, 0, 12], np.full(3, 7.0)
TISSUES = {1: "kidney", 2: "urine"}
THIN, THICK = (1.5, 1.5, 1.5), (1.0, 1.2, 5.0)


def organ() -> trimesh.Trimesh:
    return ellipsoid(KIDNEY)


def made(spacing, kidney_hu, bright, labelled=None):
    """The CT (z, y, x) of a kidney in fat with bright pieces, of which one is labelled as urine, and its
    labels.
    """
    image = grid_around(KIDNEY[0] - 50, KIDNEY[0] + 50, spacing)
    points = points_of(image)
    hu = np.where(level(points, KIDNEY) < 0, kidney_hu, FAT_HU)
    coded = (level(points, KIDNEY) < 0).astype(np.uint8)
    for solid in bright:
        hu[level(points, solid) < 0] = BRIGHT_HU
    if labelled is not None:
        coded[level(points, labelled) < 0] = 2
    return VoxelGrid.of(image), hu, coded


def mapped(grid, hu, coded) -> TissueMap:
    own = codes_of_labels(coded.transpose(2, 1, 0), TISSUES)
    ct = np.ascontiguousarray(hu.transpose(2, 1, 0), np.float32)
    return tissue_map(ct, own, organ(), grid.index_from_mm, draws=False)


@cache
def bare_of(spacing, labelled) -> TissueMap:
    """What is shown where the CT has nothing but fat."""
    return mapped(*made(spacing, FAT_HU, [], labelled))


def shown(spacing, kidney_hu, bright, labelled) -> dict[str, float]:
    """Volumes [ml] of what the tissue map shows, but for what is labelled so."""
    classes = mapped(*made(spacing, kidney_hu, bright, labelled))
    bare = bare_of(spacing, None if labelled is None else tuple(map(tuple, labelled)))
    ml = float(np.prod(np.linalg.norm(np.linalg.inv(classes.index_from_mm[:3, :3]), axis=0)) / 1000)
    return {
        tissue: ml * float((classes.mask(tissue) & ~bare.mask(tissue)).sum()) for tissue in ("urine", "stone")
    }


@pytest.mark.parametrize("spacing", [THIN, THICK], ids=["thin", "thick"])
@pytest.mark.parametrize(
    ("kidney_hu", "bright", "labelled", "said"),
    [
        (ENHANCED_HU, [SMALL, PELVIS], None, ["urine"]),
        (UNENHANCED_HU, [SMALL, LARGE], None, ["urine", "stone"]),
        (UNENHANCED_HU, [SMALL], None, ["stone"]),
        (ENHANCED_HU, [LABELLED], LABELLED, []),
        (ENHANCED_HU, [], None, []),
    ],
    ids=["enhanced", "unenhanced, large and small", "unenhanced, small", "labelled", "nothing"],
)
def test_an_import_says_what_the_tissue_map_shows(spacing, kidney_hu, bright, labelled, said):
    grid, hu, coded = made(spacing, kidney_hu, bright, labelled)
    warnings, note = dense_findings(grid, hu, coded, TISSUES, organ())
    ml = shown(spacing, kidney_hu, bright, labelled)
    assert len(warnings) == len(said)
    for line, tissue in zip(warnings, said, strict=True):
        # One digit after the point.
        assert float(re.match(r"[\d.]+", line)[0]) == pytest.approx(ml[tissue], abs=0.0501)
        assert ("shown as stone, with its shadow" in line) == (tissue == "stone")
        assert ("as fluid" in line) == (tissue == "urine")
        assert ("--collecting" if tissue == "stone" else "--stones") in line
    # The rim of labelled contrast agent is shown as fluid, and needs no word.
    assert all(ml[tissue] < 0.1 for tissue in ml if tissue not in said and labelled is None)
    assert ml["stone"] < 0.1 or "stone" in said
    phase = "unenhanced" if kidney_hu < ENHANCED_FROM_HU else "excretory" if said else "enhanced"
    assert f"contrast phase: {phase}, as the kidney has a median of {kidney_hu:.0f} HU" in note


def test_where_the_largest_piece_is():
    grid, hu, coded = made(THIN, UNENHANCED_HU, [SMALL, (LEFT[0] - [0, 0, 20], np.full(3, 3.0))])
    ((line,), _) = dense_findings(grid, hu, coded, TISSUES, organ())
    x, y, z = map(float, re.search(r"in the upper third, at (-?\d+), (-?\d+), (-?\d+) mm", line).groups())
    # Rounded to 1 mm; a ball on a grid has its middle within a voxel of 1.5 mm.
    assert np.abs(SMALL[0] - [x, y, z]).max() < 0.5 + 1.5
    assert 4 / 3 * np.pi * SMALL[1].prod() / 1000 < LARGEST_STONE_ML


@pytest.mark.parametrize(("above", "lines"), [(1.0, 1), (-1.0, 0)])
def test_dense_is_what_the_tissue_map_takes_for_it(above, lines):
    grid, hu, coded = made(THIN, ENHANCED_HU, [SMALL])
    hu[hu == BRIGHT_HU] = ENHANCED_HU + DENSE_ABOVE_HU + above
    assert len(dense_findings(grid, hu, coded, TISSUES, organ())[0]) == lines


def test_what_a_class_image_corrects_is_decided():
    grid, hu, coded = made(THIN, ENHANCED_HU, [SMALL])
    corrections = grid.image((hu == BRIGHT_HU).astype(np.uint8))
    warnings, note = dense_findings(grid, hu, coded, TISSUES, organ(), corrections)
    # What is left is its rim: voxels that are as bright by partial volume.
    assert warnings == () or "the largest piece 0." in warnings[0], note
