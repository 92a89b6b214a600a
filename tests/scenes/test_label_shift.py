"""Labels that are shifted against their CT: a synthetic body, and real CTs with labels where they are
there.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation
from synthetic_body import BODY, DIRECTIONS, LEFT, TUMOUR, drawn, grid_around, level, points_of, with_voxels

from scenes.patients.import_warnings import fat_warnings
from scenes.patients.label_shift import LATTICE_MM, LEAST_MM, best_shift, shift_warnings
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import box_of
from scenes.volumes.voxel_grid import VoxelGrid

SHIFTS = [4.0 * sign * axis for axis in np.eye(3) for sign in (-1, 1)]
WORDS = [
    "4 mm to the patient's left",
    "4 mm to the patient's right",
    "4 mm to the back",
    "4 mm to the front",
    "4 mm to the head",
    "4 mm to the feet",
]


# No axis along one of the patient, and none of them exchanged with another alone.
TURNED = Rotation.from_rotvec(75 * np.array([1, 2, 2]) / 3, degrees=True).as_matrix()


def scanned(spacing=(1.5, 1.5, 3.0), direction="identity", beside=30.0, noise_hu=15.0):
    """CT and organ of a left kidney with a tumour, in fat but for a neighbour at its front, on one grid."""
    low, high = LEFT[0] - LEFT[1] - 30, LEFT[0] + LEFT[1] + 30
    empty = grid_around(low, high, spacing, DIRECTIONS.get(direction, TURNED))
    beside_it = LEFT[0] - [0, 60, 0], np.array([80.0, 42.0, 80.0])
    ct = drawn(empty, (-100, BODY), (int(beside), beside_it), (120, LEFT), (70, TUMOUR))
    hounsfield = sitk.GetArrayFromImage(ct) + np.random.default_rng(3).normal(
        0, noise_hu, points_of(ct).shape[:3]
    )
    organ = sitk.GetArrayFromImage(drawn(empty, (1, LEFT), (1, TUMOUR))) > 0
    return with_voxels(ct, np.rint(hounsfield).astype(np.int16)), organ


def warned(ct, label, organ):
    return shift_warnings(VoxelGrid.of(ct), sitk.GetArrayFromImage(ct), label, organ)


@pytest.fixture(scope="module")
def ct_and_organ():
    return scanned()


@pytest.fixture(scope="module")
def thick():
    return scanned(spacing=(0.8, 1.0, 8.0), direction="turned")


@pytest.mark.parametrize(("shift", "words"), [*zip(SHIFTS, WORDS, strict=True)])
def test_the_way_back_is_stated(ct_and_organ, shift, words):
    ct, organ = ct_and_organ
    grid = VoxelGrid.of(ct)
    (line,) = warned(ct, replace(grid, origin=grid.origin + shift), organ)
    assert words in line and " and " not in line.split(";")[0]


# Enhanced and not, beside tissue as bright and brighter than the kidney, noisy, in thick slices, along any
# axes.
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"beside": 120.0},
        {"beside": 300.0},
        {"noise_hu": 60.0},
        {"spacing": (0.8, 0.8, 5.0)},
        {"spacing": (3.0, 3.0, 3.0)},
        {"direction": "RAS"},
        {"direction": "turned", "spacing": (1.0, 1.4, 2.8)},
    ],
)
def test_the_shift_is_found_and_none_where_there_is_none(how):
    ct, organ = scanned(**how)
    grid = VoxelGrid.of(ct)
    hounsfield = sitk.GetArrayFromImage(ct)
    assert warned(ct, grid, organ) == ()
    shift = np.array([3.0, -4.0, 5.0])
    found = best_shift(grid, hounsfield, replace(grid, origin=grid.origin + shift), organ)
    # Half a step of the lattice along each axis is certain even where the parabola is not.
    np.testing.assert_allclose(found, -shift, atol=0.5 * LATTICE_MM)


@pytest.mark.parametrize("drawn_mm", [-1.5, 1.5])
def test_readers_who_draw_inside_or_outside_the_edge_give_no_warning(ct_and_organ, drawn_mm):
    ct, _ = ct_and_organ
    points = points_of(ct)
    organ = np.min([level(points, (centre, axes + drawn_mm)) for centre, axes in (LEFT, TUMOUR)], axis=0) < 0
    assert warned(ct, VoxelGrid.of(ct), organ) == ()


@pytest.mark.parametrize(
    ("shift", "lines"), [([0.0, 0.0, 3.5], 0), ([0.0, 0.0, 5.0], 1), ([3.5, 0.0, 0.0], 1)]
)
def test_a_shift_of_less_than_half_a_slice_is_within_it(thick, shift, lines):
    ct, organ = thick
    grid = VoxelGrid.of(ct)
    shifted = replace(grid, origin=grid.origin + TURNED @ shift)
    assert np.linalg.norm(best_shift(grid, sitk.GetArrayFromImage(ct), shifted, organ)) > LEAST_MM
    assert len(warned(ct, shifted, organ)) == lines


# Beyond the lattice no place is known: the fat in the rim is told instead.
@pytest.mark.parametrize("shift", [[0.0, 16.0, 0.0], [-20.0, 0.0, 0.0], [0.0, 0.0, 30.0]])
def test_no_shift_is_stated_where_the_fit_is_beyond_reach(ct_and_organ, shift):
    ct, organ = ct_and_organ
    grid = VoxelGrid.of(ct)
    assert warned(ct, replace(grid, origin=grid.origin + shift), organ) == ()


@pytest.mark.parametrize("side", [0, 1, 2])
def test_the_share_of_fat_is_that_of_a_shell_of_4_mm(side):
    """A cuboid of 32 x 40 x 48 mm has 30.7 ml within 4 mm of its faces; with 3 or 4 mm of fat on one side
    of it.
    """
    spacing, size_mm = np.array([1.0, 2.0, 4.0]), np.array([32.0, 40.0, 48.0])
    count = np.rint(size_mm / spacing).astype(int)
    organ = np.pad(np.ones(count[::-1], bool), 3)
    hounsfield = np.full(organ.shape, 120.0)
    layers = (3, 2, 1)[side]
    np.moveaxis(hounsfield, 2 - side, 0)[3 : 3 + layers] = -100.0
    grid = VoxelGrid(organ.shape[::-1], spacing, np.array([40.0, -7.0, 900.0]), TURNED)
    (warning,) = fat_warnings(grid, hounsfield, organ, organ, 4.0)
    fat = layers * spacing[side] * size_mm.prod() / size_mm[side]
    assert warning.startswith(
        f"{fat / (size_mm.prod() - (size_mm - 8).prod()):.0%} of the organ's rim is fat"
    )


@pytest.mark.parametrize(
    ("ct", "kidneys", "value"),
    [
        ("crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", 1),
        ("crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", 2),
        ("totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 1),
        ("totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 2),
    ],
)
def test_real_kidneys(data: Path, ct, kidneys, value):
    volume = open_ct(data / "ct" / ct)
    image = sitk.ReadImage(str(data / "ct" / kidneys))
    grid, organ = VoxelGrid.of(image), sitk.GetArrayFromImage(image) == value
    box = box_of(organ)
    label, inside = grid.part(box), organ[box[::-1]]
    around = volume.grid.box_around(label.bounds()[0] - 20.0, label.bounds()[1] + 20.0)
    part, hounsfield = volume.grid.part(around), volume.hounsfield(around)
    assert shift_warnings(part, hounsfield, label, inside) == ()
    for shift in SHIFTS:
        assert len(shift_warnings(part, hounsfield, replace(label, origin=label.origin + shift), inside)) == 1
