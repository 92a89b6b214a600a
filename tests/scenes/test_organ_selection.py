"""Which voxels are the organ, its parts and its marks, in detail."""

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial import cKDTree
from synthetic_body import BODY, LEFT, RIGHT, body, drawn, grid_around, with_voxels
from test_patient_import import imported, organ_taken

import scenes.patients.patient_import
from errors import PatientError
from scenes.patients.organ_selection import choose_organ, closing, find_organs, midline_x
from scenes.patients.part_surfaces import PEDICLE_MM, colours_of_labels, near_organ, part_surface
from scenes.patients.patient_import import import_patient
from scenes.patients.readers.label_maps import LabelMap, Segment
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import VoxelGrid


@pytest.fixture(scope="module")
def ct_and_labels():
    return body()


class TestOrgan:
    @pytest.mark.parametrize("sense", [1, -1])
    def test_midline_is_the_bodys(self, sense):
        """Not that of the box around an arm or a table's edge, nor that of another height."""
        empty = grid_around((-330, -120, -90), (330, 120, 90), (5.0, 5.0, 5.0))
        arm = np.array([sense * 230.0, 40.0, 0.0]), np.array([95.0, 9.0, 9.0])
        higher = np.array([sense * 120.0, 0.0, 80.0]), np.array([160.0, 110.0, 25.0])
        ct = sitk.GetArrayFromImage(drawn(empty, (40, BODY), (60, arm), (50, higher)))
        assert abs(midline_x(VoxelGrid.of(empty), ct, -40.0, 40.0)) < 10

    @pytest.mark.parametrize(
        "right_x, left_x, is_told", [(-45.0, 30.0, True), (20.0, 90.0, True), (1.0, 55.0, False)]
    )
    def test_without_a_body_two_kidneys_are_told_apart_by_their_distance(self, right_x, left_x, is_told):
        """Farther than 60 mm they are two, with the midline between them; closer ones may be pieces of
        one.
        """
        empty = grid_around((-80, -30, -60), (130, 90, 80), (4.0, 4.0, 4.0))
        axes = np.array([14.0, 20.0, 40.0])
        both = [(np.array([x, 30.0, 0.0]), axes) for x in (right_x, left_x)]
        pieces = find_organs(LabelMap.of(drawn(empty, (1, both[0]), (1, both[1]))))
        assert len(pieces) == 2
        if is_told:
            assert [choose_organ(pieces, None, side) for side in ("right", "left")] == [
                (pieces[0], "right"),
                (pieces[1], "left"),
            ]
        else:
            with pytest.raises(PatientError):
                choose_organ(pieces, None, "left")

    def test_island_is_no_organ(self):
        empty = grid_around((-110, -30, -60), (110, 90, 80), (3.0, 3.0, 3.0))
        island = RIGHT[0], np.full(3, 9.0)  # 3 ml
        (one,) = find_organs(LabelMap.of(drawn(empty, (1, LEFT), (1, island))))
        assert one.centre_x_mm == pytest.approx(LEFT[0][0], abs=0.5)

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize(("apart_mm", "closed"), [(16, True), (28, False)])
    def test_hollow_is_of_its_width_in_mm(self, axis, apart_mm, closed):
        """A vein in a notch, half as deep as the kidney, across each axis of uneven voxels."""
        spacing = np.array([4.0, 1.0, 2.0])  # z, y, x
        values = np.ones([int(n) for n in 60 / spacing], np.uint8)
        gap, notch = int(apart_mm / spacing[axis]), [slice(None)] * 3
        notch[axis] = slice(start := (values.shape[axis] - gap) // 2, start + gap)
        notch[axis - 1] = slice(values.shape[axis - 1] // 2)
        values[tuple(notch)] = 2
        grid = VoxelGrid(values.shape[::-1], spacing[::-1], np.zeros(3), np.eye(3))
        (piece,) = find_organs(LabelMap.valued(grid, values, {1: "kidney", 2: "renal vein"}))
        at = [n // 2 for n in values.shape]
        at[axis - 1] //= 2
        assert piece.mask[tuple(at)] == closed

    def test_hollow_ends_where_the_organ_does(self):
        """What lies around a box does not change what is hollow in it."""
        places = points = np.stack(np.meshgrid(*[np.arange(n) for n in (20, 24, 22)], indexing="ij"), axis=-1)
        mask = (np.linalg.norm((points - (9, 12, 11)) / (10, 12, 11), axis=-1) < 1) & (
            np.linalg.norm(places - (0, 12, 11), axis=-1) > 7
        )
        wide = closing(np.pad(mask, 20), np.full(3, 2.0))[20:-20, 20:-20, 20:-20]
        assert np.array_equal(closing(mask, np.full(3, 2.0)), wide) and wide.sum() > mask.sum()

    def test_kidney_halves_without_a_body(self):
        """Two pieces near each other may be one kidney's: no midline lies between them."""
        empty = grid_around((30, -30, -100), (110, 90, 110), (3.0, 3.0, 3.0))
        halves = [
            (LEFT[0] + [sense * 14.0, 0, sense * 45.0], np.array([20.0, 20.0, 30.0])) for sense in (1, -1)
        ]
        labels = drawn(empty, *((1, half) for half in halves))
        with pytest.raises(PatientError, match="2 organs are labelled"):
            organ_taken(drawn(empty, (40, BODY)), labels, [1], "left")

    def test_ct_without_a_negative_value(self, ct_and_labels):
        ct, labels = ct_and_labels
        clipped = with_voxels(ct, np.maximum(sitk.GetArrayFromImage(ct), 0))
        with pytest.raises(PatientError, match="has values from 0 to 120: expected HU"):
            imported(clipped, labels, organ=[2])


class TestParts:
    @pytest.fixture
    def labels(self):
        """A kidney in one large vessel."""
        empty = grid_around((20, -30, -80), (120, 100, 100), (2.0, 3.0, 5.0))
        return LabelMap.of(
            drawn(empty, (1, (LEFT[0], np.full(3, 1e4))), (2, LEFT)), {1: "renal vein", 2: "kidney_left"}
        )

    def test_vessels_as_far_as_the_pedicle(self, labels):
        (piece,) = find_organs(labels)
        grid, inside = near_organ(labels, piece, [1])
        organ = piece.grid.place(np.argwhere(piece.mask)[:, ::-1])
        everything = labels.grid.place(np.argwhere(labels.values == 1)[:, ::-1])
        near = cKDTree(organ).query(everything)[0] <= PEDICLE_MM
        assert inside.sum() == near.sum()
        np.testing.assert_allclose(grid.place(np.argwhere(inside)[:, ::-1]), everything[near], atol=1e-9)

    def test_several_bodies_without_specks(self):
        empty = grid_around((-40, -20, -20), (60, 20, 20), (1.5, 1.5, 1.5))
        balls = [(np.array([x, 0.0, 0.0]), np.full(3, r)) for x, r in ((-20, 14), (18, 10), (50, 3))]
        image = drawn(empty, *((1, ball) for ball in balls))
        surface = part_surface(VoxelGrid.of(image), sitk.GetArrayFromImage(image) > 0, "tumour")
        assert surface.body_count == 2 and surface.bounds[1, 0] == pytest.approx(28, abs=1.5)

    def test_the_first_colour_counts(self):
        segments = {n: Segment("kidney", n, "kidney", None, (n / 4, 0.0, 0.0)) for n in (1, 2, 3)}
        labels = LabelMap(
            VoxelGrid((2, 2, 2), np.ones(3), np.zeros(3), np.eye(3)), np.zeros((2, 2, 2), np.uint8), segments
        )
        assert colours_of_labels(labels, ["tumour"]) == {"organ": (0.25, 0.0, 0.0)}


def test_vessels_are_no_bed(ct_and_labels, monkeypatch):
    taken = {}
    monkeypatch.setattr(
        scenes.patients.patient_import,
        "bed_of_labels",
        lambda organ, labels, own, gravity: taken.update(own=own) or organ,
    )
    ct, labels = ct_and_labels
    vessel = LEFT[0] + [0, 30, 0], np.array([20.0, 8.0, 40.0])
    named = LabelMap.of(drawn(labels, (4, vessel), (2, LEFT)), {2: "kidney_left", 4: "renal vein"})
    import_patient(LazyVolume.of(ct), named, margin_mm=5.0, support="labels")
    assert set(taken["own"]) == {2, 4}


def test_marks_of_the_organ_alone(ct_and_labels, monkeypatch):
    """A tumour of the other kidney is none of this patient's, and what grows in no organ is not drawn."""
    monkeypatch.setattr(scenes.patients.patient_import, "_support", lambda kind, organ, *_: organ)
    ct, labels = ct_and_labels
    other = RIGHT[0] + [25.0, 0, 0], np.full(3, 10.0)
    named = LabelMap.of(
        drawn(labels, (1, RIGHT), (2, LEFT), (3, other)), {1: "kidney_right", 2: "kidney_left", 3: "mass"}
    )
    patient = import_patient(LazyVolume.of(ct), named, side="left", margin_mm=150.0)
    assert set(np.unique(sitk.GetArrayViewFromImage(patient.labels)).tolist()) == {0, 1} and not patient.parts
