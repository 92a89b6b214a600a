"""A header that turns or mirrors a CT is contradicted by its anatomy, as far as the CT shows it; a correct
one never is.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from synthetic_body import BODY, DIRECTIONS, LEFT, RIGHT, drawn, grid_around

from scenes.patients.body_orientation import _lungs_z, orientation_warnings
from scenes.patients.organ_selection import midline_x
from scenes.patients.patient_import import _overview
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.voxel_grid import VoxelGrid

LIVER = np.array([-80.0, -20.0, 60.0]), np.array([70.0, 70.0, 60.0])
SPLEEN = np.array([105.0, 20.0, 70.0]), np.array([30.0, 35.0, 45.0])
SPINE = np.array([0.0, 75.0, 0.0]), np.array([20.0, 20.0, 400.0])
LUNGS = [(np.array([s * 85.0, 0.0, 150.0]), np.array([55.0, 70.0, 60.0])) for s in (-1, 1)]
NO_LABELS = LabelMap(
    VoxelGrid((2, 2, 2), np.ones(3), np.zeros(3), np.eye(3)), np.zeros((2, 2, 2), np.uint8), {}
)
WORDS = {
    "": [],
    "x": ["liver is on the patient's left"],
    "y": ["bones are in front"],
    "z": ["are below the kidney's middle"],
}


@cache
def trunk(direction="identity", liver_hu=105.0):
    """A trunk of fat and muscle with noise, as grid and HU (z, y, x)."""
    empty = grid_around((-170, -120, -130), (170, 120, 170), (3.0, 3.0, 5.0), DIRECTIONS[direction])
    solids = [(-100, BODY), (liver_hu, LIVER), (110, SPLEEN), (500, SPINE), (160, LEFT), (160, RIGHT)]
    image = drawn(empty, *((hu + 1000, solid) for hu, solid in solids), *((200, lung) for lung in LUNGS))
    stored = sitk.GetArrayFromImage(image)
    hounsfield = np.where(stored < 0, -1000, stored - 1000) + np.random.default_rng(1).normal(
        0, 15, stored.shape
    )
    return VoxelGrid.of(image), np.rint(hounsfield).astype(np.int16)


def warnings(grid, hounsfield, flip, organ_z, labels=NO_LABELS):
    """Those of a header that exchanges the directions of some axes."""
    signs = np.array([-1.0 if axis in flip else 1.0 for axis in "xyz"])
    turned = replace(grid, origin=signs * grid.origin, direction=signs[:, None] * grid.direction)
    midline = midline_x(turned, hounsfield, -1000, 1000)
    return orientation_warnings(_overview(turned, hounsfield), labels, midline, signs[2] * organ_z)


def test_the_overview_has_the_voxels_nearest_to_15_tenths_of_a_mm_in_place():
    spacing, origin = np.array([0.9, 0.6, 2.0]), np.array([-10.0, 5.0, 30.0])
    grid = VoxelGrid((20, 30, 8), spacing, origin, np.eye(3))
    hounsfield = np.random.default_rng(2).integers(-500, 500, (8, 30, 20)).astype(np.int16)
    overview = _overview(grid, hounsfield)
    # Between one and two, two and three, and none of each voxel.
    assert overview.GetSpacing() == pytest.approx((1.8, 1.2, 2.0))
    place = overview.TransformIndexToPhysicalPoint((3, 7, 5))
    assert overview[3, 7, 5] == hounsfield[tuple(np.rint((place - origin) / spacing).astype(int)[::-1])]


@pytest.mark.parametrize("spacing_z, is_lung", [(4.0, True), (3.99, False)])
def test_gas_in_the_body_is_a_lung_from_150_ml_on(spacing_z, is_lung):
    """A box of 12 x 16 x 13 cells without its edges, which an opening takes: 2348 cells, of 150.3 ml or
    149.9 ml.
    """
    mean = np.full((30, 30, 30), -1000.0)
    mean[:, 3:27, 3:27] = 0.0
    mean[8:21, 7:23, 9:21] = -800.0
    grid = VoxelGrid((30, 30, 30), np.array([4.0, 4.0, spacing_z]), np.zeros(3), np.eye(3))
    assert _lungs_z(grid, mean) == (pytest.approx(14 * spacing_z) if is_lung else None)


def check(found, flip):
    expected = [words for axis in ("y", "x", "z") if axis in flip for words in WORDS[axis]]
    assert len(found) == len(expected), found
    assert all(words in line for words, line in zip(expected, found, strict=True))


@pytest.mark.parametrize("flip", ["", "x", "y", "z", "xy"])
def test_a_trunk(flip):
    check(warnings(*trunk(), flip, 0.0), flip)


@pytest.mark.parametrize(
    ("direction", "liver_hu"), [("RAS", 105.0), ("left-handed", 105.0), ("identity", 50.0)]
)
@pytest.mark.parametrize("flip", ["", "x"])
def test_the_order_of_voxels_and_the_contrast(flip, direction, liver_hu):
    check(warnings(*trunk(direction, liver_hu), flip, 0.0), flip)


@pytest.mark.parametrize("flip", ["", "x"])
def test_a_body_of_one_hu_shows_nothing(flip):
    empty = grid_around((-170, -120, -130), (170, 120, 130), (4.0, 4.0, 5.0))
    image = drawn(empty, (40, BODY), (120, LEFT))
    assert warnings(VoxelGrid.of(image), sitk.GetArrayFromImage(image), flip, 0.0) == ()


def test_a_large_spleen_and_stomach_are_no_liver():
    """Beside a liver: together on the left they are as large as it."""
    grid, hounsfield = trunk()
    image = grid.image(hounsfield)
    stomach = np.array([60.0, -40.0, 80.0]), np.array([50.0, 45.0, 50.0])
    large = SPLEEN[0], SPLEEN[1] * 1.3
    filled = drawn(image, (20, stomach), (110, large))
    mixed = np.where(
        sitk.GetArrayViewFromImage(filled) > -1000, sitk.GetArrayViewFromImage(filled), hounsfield
    )
    assert warnings(grid, mixed.astype(np.int16), "", 0.0) == ()


@pytest.mark.parametrize("flip", ["", "x", "y", "z", "xy"])
@pytest.mark.parametrize("name", ["crlm_1004", "totalseg/ct.nii.gz"])
def test_real_bodies(data: Path, name, flip):
    grid, hounsfield, middle_z = real_body(data, name)
    found = warnings(grid, hounsfield, flip, middle_z)
    check(found, flip)


@cache
def real_body(data, name):
    """Grid and HU (z, y, x) of a CT at the level of the kidneys, and their middle, LPS z."""
    volume = open_ct(data / "ct" / name)
    labels = (
        "crlm_1004_labels/kidneys_provisional.nii.gz" if name == "crlm_1004" else "totalseg/kidneys.nii.gz"
    )
    kidneys = sitk.ReadImage(str(data / "ct" / labels))
    z = VoxelGrid.of(kidneys).place(np.argwhere(sitk.GetArrayViewFromImage(kidneys))[:, ::-1])[:, 2]
    low, high = volume.grid.bounds()
    low[2], high[2] = z.min() - 60, z.max() + 60
    box = volume.grid.box_around(low, high)
    return volume.grid.part(box), volume.hounsfield(box), (z.min() + z.max()) / 2
