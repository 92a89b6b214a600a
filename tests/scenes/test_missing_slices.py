"""A slice that nobody segmented is named and filled, bridged by the tumour or not; what is anatomy stays
as it is.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from synthetic_body import (
    BODY,
    DIRECTIONS,
    LEFT,
    RIGHT,
    TUMOUR,
    body,
    coarsely,
    drawn,
    grid_around,
    points_of,
)

from scenes.patients.missing_slices import fill_missing_slices
from scenes.patients.organ_selection import find_organs
from scenes.patients.patient_import import import_patient
from scenes.patients.patient_scene import hilum
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import VoxelGrid

NAMES = {1: "kidney_right", 2: "kidney_left", 3: "tumour"}
ORGAN = [1, 2]


def label_map(image, voxels=None):
    voxels = sitk.GetArrayFromImage(image) if voxels is None else voxels
    return LabelMap.valued(VoxelGrid.of(image), voxels.astype(np.uint8), NAMES)


def without(image, slices, axis=2, keep=()):
    """A label map whose slices along an axis (x, y, z) have none of the left side's labels but those kept."""
    voxels = sitk.GetArrayFromImage(image)
    is_left = points_of(image)[..., 0] > 0
    view, left = np.moveaxis(voxels, 2 - axis, 0), np.moveaxis(is_left, 2 - axis, 0)
    for k in slices:
        view[k][left[k] & ~np.isin(view[k], keep)] = 0
    return label_map(image, voxels)


@pytest.fixture(scope="module")
def thick():
    return body(spacing=(2.0, 2.0, 5.0))


def middle(labels, solid=LEFT):
    """The number of the slice through the middle of a solid."""
    return int(np.rint(VoxelGrid.of(labels).index(solid[0][None])[0, 2]))


class TestFilled:
    @pytest.mark.parametrize("count", [1, 2])
    def test_the_organ_and_its_tumour(self, thick, count):
        k = middle(thick[1], TUMOUR)
        filled, warnings = fill_missing_slices(without(thick[1], range(k, k + count)), ORGAN)
        whole = sitk.GetArrayFromImage(thick[1])
        for slices in range(k, k + count):
            differ = (filled.values[slices] > 0) != (whole[slices] > 0)
            # Between two sections of an ellipsoid there is more of it than between their outlines.
            assert differ.sum() < 0.1 * count * (whole[slices] > 1).sum()
        assert np.array_equal(filled.values[: k - 1], whole[: k - 1])
        names = [warning for warning in warnings if "no kidney is labelled in the slice" in warning]
        z = [VoxelGrid.of(thick[1]).place([[0, 0, n]])[0, 2] for n in range(k, k + count)]
        assert len(names) == 1 and all(f"z {one:.1f} mm (around x " in names[0] for one in z)
        assert any("no tumour is labelled in" in warning for warning in warnings)

    @pytest.mark.parametrize("above", [0, 7], ids=["middle", "pole"])
    def test_a_slice_that_the_tumour_bridges(self, thick, above):
        k = middle(thick[1]) + above
        filled, (warning,) = fill_missing_slices(without(thick[1], [k], keep=(3,)), ORGAN)
        z = VoxelGrid.of(thick[1]).place([[0, 0, k]])[0, 2]
        assert f"z {z:.1f} mm (around x " in warning and "no kidney" in warning
        (piece,) = [p for p in find_organs(filled, ORGAN) if p.centre_x_mm > 0]
        (whole,) = [p for p in find_organs(label_map(thick[1]), ORGAN) if p.centre_x_mm > 0]
        assert piece.volume_ml == pytest.approx(whole.volume_ml, rel=0.01)

    @pytest.mark.parametrize("is_first", [True, False])
    def test_what_is_labelled_on_one_side_alone_is_the_tissue_between(self, is_first):
        """Cortex below, medulla above, and a narrower section on one side: in its rim the slice between
        has the other side's value.
        """
        voxels = np.zeros((9, 40, 40), np.uint8)
        voxels[:4, 4:36, 4:36], voxels[5:, 4:36, 4:36] = 1, 2
        narrow = np.s_[3 if is_first else 5]
        voxels[narrow] = 0
        voxels[narrow, 10:30, 4:36] = 1 if is_first else 2
        grid = VoxelGrid((40, 40, 9), np.array([1.0, 1.0, 4.0]), np.zeros(3), np.eye(3))
        filled, warnings = fill_missing_slices(
            LabelMap.valued(grid, voxels, {1: "cortex", 2: "medulla"}), ORGAN
        )
        assert "z 16.0 mm" in warnings[0]
        between = filled.values[4]
        assert (between[12:28, 8:32] == 1).all()
        rim = between[np.r_[6:9, 31:34]][:, 8:32]
        assert rim.any() and set(np.unique(rim)) <= {0, 2 if is_first else 1}

    def test_the_place_is_in_a_kidney_where_both_lack_a_slice(self, thick):
        k = middle(thick[1])
        voxels = sitk.GetArrayFromImage(thick[1])
        voxels[k] = 0
        _, warnings = fill_missing_slices(label_map(thick[1], voxels), ORGAN)
        assert abs(float(re.search(r"no kidney.*around x (-?\d+)", " ".join(warnings))[1])) > 35

    @pytest.mark.parametrize("direction", ["identity", "left-handed"])
    def test_a_tumour_does_not_grow_into_missing_slices(self, direction):
        """In either order of slices: two of the kidney are missing below the tumour's end."""
        _, image = body(DIRECTIONS[direction], spacing=(2.0, 2.0, 4.0))
        heights = points_of(image)[:, 0, 0, 2]
        missing = np.flatnonzero((heights > 0) & (heights < TUMOUR[0][2] - TUMOUR[1][2]))
        assert len(missing) == 2
        filled, _ = fill_missing_slices(without(image, missing), ORGAN)
        assert (filled.values == 3).sum() == (sitk.GetArrayFromImage(image) == 3).sum()
        assert (filled.values[missing] == 2).any(axis=(1, 2)).all()

    def test_a_tumour_alone(self, thick):
        voxels = sitk.GetArrayFromImage(thick[1])
        k = middle(thick[1], TUMOUR)
        voxels[k][voxels[k] == 3] = 2
        filled, (warning,) = fill_missing_slices(label_map(thick[1], voxels), ORGAN)
        assert "no tumour is labelled in the slice z" in warning
        assert (filled.values[k] == 3).sum() == pytest.approx(
            (sitk.GetArrayFromImage(thick[1])[k] == 3).sum(), rel=0.25
        )

    @pytest.mark.parametrize(("axis", "thickness"), [(0, 3.0), (1, 3.0), (2, 3.0), (2, 2.5)])
    def test_along_any_axis_also_of_slices_thinner_than_pixels(self, axis, thickness):
        _, labels = body(spacing=(3.0, 3.0, thickness))
        k = int(np.rint(VoxelGrid.of(labels).index(LEFT[0][None])[0, axis]))
        filled, warnings = fill_missing_slices(without(labels, [k], axis), ORGAN)
        place = VoxelGrid.of(labels).place(np.full((1, 3), k))[0, axis]
        assert f"{'xyz'[axis]} {place:.1f} mm" in " ".join(warnings)
        plane = np.moveaxis(filled.values, 2 - axis, 0)[k]
        assert (plane == 2).any()

    @pytest.mark.parametrize(
        ("direction", "axis", "spacing"),
        [("slices first", 0, (5.0, 2.0, 3.0)), ("oblique", 2, (2.0, 3.0, 5.0))],
    )
    def test_the_place_in_a_turned_label(self, direction, axis, spacing):
        """A plane across n at a distance d from an ellipsoid's middle cuts an ellipse about d A n / n'A n,
        where A has the squares of its axes.
        """
        empty = grid_around((20, -10, -50), (130, 80, 80), spacing, DIRECTIONS[direction])
        labels, grid = drawn(empty, (2, LEFT)), VoxelGrid.of(empty)
        k = int(np.rint(grid.index(LEFT[0] + [0, 0, 18.0]))[axis])
        _, (warning,) = fill_missing_slices(without(labels, [k], axis), ORGAN)
        normal, along = grid.direction[:, axis], LEFT[1] ** 2 * grid.direction[:, axis]
        away = (grid.place(np.full(3, k)) - LEFT[0]) @ normal
        x, y, z = LEFT[0] + away * along / (along @ normal)
        place = re.search(r"z (-?[\d.]+) mm \(around x (-?\d+), y (-?\d+)\)", warning).groups()
        # Its pixels are counted to a part of one, of 2 x 3 mm.
        assert np.array(place, float) == pytest.approx([z, x, y], abs=1.0)


def assert_left(labels, organ):
    filled, warnings = fill_missing_slices(labels, organ)
    assert filled is labels and warnings == ()


class TestLeft:
    """What is not missing."""

    @pytest.mark.parametrize("spacing", [(2.5, 2.5, 5.0), (3.0, 3.0, 3.0)])
    @pytest.mark.parametrize("direction", ["identity", "oblique", "slices first"])
    def test_whole_kidneys(self, direction, spacing):
        labels = label_map(body(DIRECTIONS[direction], spacing)[1])
        assert_left(labels, ORGAN)

    def test_a_wide_gap(self, thick):
        k = middle(thick[1])
        labels = without(thick[1], range(k - 2, k + 3))
        assert_left(labels, ORGAN)

    @pytest.mark.parametrize(("width", "count"), [(3, 0), (6, 1)])
    def test_the_end_of_a_lobe(self, width, count):
        """A section of less than 1 cm2: 5 rows of 3 pixels of 4 mm2, in slices of 5 mm; twice as wide it
        is missing.
        """
        values = np.zeros((20, 20, 20), np.uint8)
        values[:, 5:10, 5 : 5 + width], values[10] = 2, 0
        grid = VoxelGrid((20, 20, 20), np.array([2.0, 2.0, 5.0]), np.zeros(3), np.eye(3))
        assert len(fill_missing_slices(LabelMap.valued(grid, values, NAMES), [2])[1]) == count

    @pytest.mark.parametrize("apart_mm", [11.0, 16.0])
    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_two_bodies_that_face_each_other(self, axis, apart_mm):
        """Between the ends of a kidney and of an island there are no missing slices."""
        empty = grid_around((20, -40, -100), (160, 120, 120), (2.5, 2.5, 2.5))
        beside = np.zeros(3)
        beside[axis] = LEFT[1][axis] + 14.0 + apart_mm
        labels = label_map(drawn(empty, (2, LEFT), (2, (LEFT[0] + beside, np.full(3, 14.0)))))
        assert_left(labels, [2])

    @pytest.mark.parametrize("touching_mm", [1.5, 3.0])
    def test_a_tumour_that_hardly_touches(self, touching_mm):
        """Fat between an exophytic tumour and the kidney is no missing slice."""
        tumour = LEFT[0] + [43.0 - touching_mm, 0, 0], np.full(3, 18.0)
        empty = grid_around((20, -20, -50), (150, 80, 80), (3.0, 3.0, 3.0))
        assert_left(label_map(drawn(empty, (2, LEFT), (3, tumour))), [2])

    def test_two_tumours_apart(self):
        empty = grid_around((30, -10, -60), (130, 80, 80), (2.0, 2.0, 3.0))
        small = np.full(3, 7.0)
        above, below = ((LEFT[0] + [10.0, 0, z], small) for z in (12.5, -12.5))
        labels = label_map(drawn(empty, (2, LEFT), (3, above), (3, below)))
        assert_left(labels, [2])

    def test_a_cleft_that_does_not_divide_the_section(self):
        """A sinus is open for some slices; around it there is kidney in each."""
        empty = grid_around((30, -10, -60), (130, 80, 80), (2.0, 2.0, 4.0))
        cleft = LEFT[0] - [25.0, 0, 0], np.array([35.0, 15.0, 3.0])
        labels = label_map(drawn(empty, (2, LEFT), (0, cleft)))
        assert_left(labels, [2])

    @pytest.mark.parametrize(
        "name", ["crlm_1004_labels/kidneys_provisional.nii.gz", "totalseg/kidneys.nii.gz"]
    )
    def test_real_kidneys(self, data: Path, name):
        (labels,) = open_labels(data / "ct" / name).maps(None)
        assert_left(labels, [1, 2])


def test_a_slit_is_not_the_hilum(monkeypatch, thick):
    """The deepest place of the surface would be in it."""
    coarsely(monkeypatch)
    sinus = LEFT[0] - [27.0, 0, 15.0], np.array([14.0, 8.0, 8.0])
    ct = drawn(thick[0], (40, BODY), (120, LEFT), (120, RIGHT), (70, TUMOUR))
    image = drawn(thick[1], (1, RIGHT), (2, LEFT), (0, sinus), (3, TUMOUR))
    labels = without(image, [middle(image) + 3], keep=(3,))
    patient = import_patient(LazyVolume.of(ct), labels, ORGAN, "left", margin_mm=10.0)
    np.testing.assert_allclose(hilum(patient.organ, "left"), sinus[0] + [14.0, 0, 0], atol=8.0)
    assert any("no kidney is labelled in the slice" in warning for warning in patient.warnings)
