"""Supports other than the mould: a bed of labels, a surface of the user's own."""

import igl
import numpy as np
import pytest
import trimesh
from synthetic_body import (
    LEFT,
    TUMOUR,
    assert_sound,
    body,
    coarsely,
    drawn,
    ellipsoid,
    grid_around,
    least_gap,
    level,
)

from errors import PatientError
from scenes.patients.organ_support import bed_of_file, bed_of_labels, mould, vertical_gaps
from scenes.patients.patient_import import import_patient
from scenes.patients.patient_position import GRAVITY
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.lazy_volume import LazyVolume

# A muscle behind the left kidney, with 4 mm of fat between.
MUSCLE = np.array([70.0, 79.0, 12.0]), np.array([45.0, 20.0, 70.0])
SUPINE = np.array(GRAVITY["supine"])
NAMES = {2: "kidney_left", 3: "tumour", 4: "psoas"}
SMALL = np.array([10.0, -20.0, 30.0]), np.array([13.0, 11.0, 18.0])


def small_organs_bed(muscle: tuple[np.ndarray, np.ndarray]) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """An organ that is soon made, and the bed of a muscle."""
    organ = ellipsoid(SMALL)
    empty = grid_around(SMALL[0] - 50, SMALL[0] + 50, (2.5, 2.5, 2.5))
    labels = LabelMap.of(drawn(empty, (4, muscle), (2, SMALL)), NAMES)
    return organ, bed_of_labels(organ, labels, [2, 3], SUPINE)


def slab(size, centre) -> trimesh.Trimesh:
    """A box of a size [mm] at a centre relative to the organ's."""
    return trimesh.creation.box(np.asarray(size, float)).apply_translation(LEFT[0] + centre)


@pytest.fixture(scope="module")
def ct_and_labels():
    ct, labels = body(spacing=(2.5, 2.5, 2.5))
    return LazyVolume.of(ct), drawn(labels, (4, MUSCLE), (2, LEFT), (3, TUMOUR))


@pytest.fixture(scope="module")
def patient(ct_and_labels):
    ct, labels = ct_and_labels
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        yield import_patient(ct, LabelMap.of(labels, NAMES), margin_mm=10.0, support="labels")


class TestBedOfLabels:
    def test_lies_on_the_muscle_with_the_fat_between(self, patient):
        assert_sound(patient.support)
        assert 0 < least_gap(patient.support, patient.organ) < 1.0
        # Behind the organ's middle the bed begins at the organ, and goes on as the muscle does.
        behind = LEFT[0] + np.outer(LEFT[1][1] + np.array([-1.0, 1.5, 4.0, 15.0]), SUPINE)
        faces = np.asarray(patient.support.faces, np.int64)
        distance = igl.signed_distance(behind, np.asarray(patient.support.vertices), faces)[0]
        assert (distance < 0).tolist() == [False, True, True, True]

    def test_beside_the_organ_it_is_the_muscle(self, patient):
        """Away from the organ, within the bed's reach, vertices lie on the muscle or on the bed's own
        ends.
        """
        vertices, bounds = patient.support.vertices, patient.support.bounds
        ends = (np.abs(vertices - bounds[0]) < 3).any(axis=1) | (np.abs(vertices - bounds[1]) < 3).any(axis=1)
        under = (((vertices - LEFT[0])[:, [0, 2]] / (LEFT[1][[0, 2]] + 4)) ** 2).sum(axis=1) < 1
        beside = vertices[~ends & ~under]
        assert len(beside) > 200
        off = np.abs(level(beside, MUSCLE)) * MUSCLE[1].min()
        assert np.percentile(off, 90) < 2.5  # a voxel

    def test_nothing_under_the_organ(self):
        aside = SMALL[0] + [-36, 30, 0], np.array([20.0, 14.0, 40.0])
        with pytest.raises(PatientError, match=r"supports \d+% of the organ: expected 50% or more"):
            small_organs_bed(aside)

    def test_ends_at_half_of_the_organs_height(self):
        """Though tissue goes on around it; less what the rounded rim takes."""
        organ, bed = small_organs_bed((SMALL[0], SMALL[1] + 30))
        assert 0 <= bed.bounds[0, 1] - organ.bounds[:, 1].mean() < 4


class TestBedOfFile:
    def test_is_taken_as_it_is(self, ct_and_labels, patient, tmp_path):
        ct, labels = ct_and_labels
        bed = slab((80, 10, 120), (0, LEFT[1][1] + 6.0, 0))
        bed.export(tmp_path / "slab.stl")
        again = import_patient(
            ct, LabelMap.of(labels, NAMES), margin_mm=10.0, support=str(tmp_path / "slab.stl")
        )
        np.testing.assert_allclose(again.support.bounds, bed.bounds, atol=1e-4)
        assert np.array_equal(again.organ.vertices, patient.organ.vertices)

    def test_what_is_no_support(self, patient, tmp_path):
        cube = (40, 40, 40)
        inside, far = slab(cube, (0, 0, 0)), slab(cube, np.array([-300.0, 0, 0]) - LEFT[0])
        open_, inward = slab(cube, (0, 60, 0)), slab((40, 10, 40), (0, 26, 0))
        open_.update_faces(np.arange(len(open_.faces)) > 0)
        inward.invert()
        for name, mesh in (("inside", inside), ("far", far), ("open", open_), ("inward", inward)):
            mesh.export(tmp_path / f"{name}.stl")
        (tmp_path / "text.stl").write_text("no surface")
        # Where x and y of the ellipsoid are equal, 15.6 mm, its surface is 4.4 mm inside the cube's; the
        # other's face is at x = -280 mm.
        for name, words in [
            ("inside", r"reaches [45]\.\d mm into the organ"),
            ("far", r"is 32[3-7] mm from the organ"),
            ("open", "not a closed surface"),
            ("inward", "faces outward"),
            ("text", "has no triangles"),
            ("absent", "no such file"),
        ]:
            with pytest.raises(PatientError, match=words) as caught:
                bed_of_file(tmp_path / f"{name}.stl", patient.organ, SUPINE)
            assert "\n" not in str(caught.value) and f"{name}.stl" in str(caught.value)


@pytest.fixture
def organ() -> trimesh.Trimesh:
    return ellipsoid(LEFT)


class TestUnderTheOrgan:
    """A support of the user's is under the organ along gravity, and close, or the organ leaves it."""

    @staticmethod
    def file(folder, *boxes):
        trimesh.util.concatenate(boxes).export(folder / "bed.stl")
        return folder / "bed.stl"

    @pytest.mark.parametrize(("position", "axis"), [("supine", 1), ("left-decubitus", 0)])
    @pytest.mark.parametrize("gap", [0.2, 3.0])
    def test_a_slab_under_it(self, tmp_path, organ, position, axis, gap):
        gravity = np.array(GRAVITY[position])
        size = np.full(3, 120.0)
        size[axis] = 10.0
        path = self.file(tmp_path, slab(size, gravity * (LEFT[1][axis] + gap + 5)))
        bed_of_file(path, organ, gravity)
        with pytest.raises(PatientError, match="is under 0% of the organ and above 100% of it"):
            bed_of_file(path, organ, -gravity)

    @pytest.mark.parametrize(
        ("size", "centre", "words"),
        [
            (
                (80, 10, 120),
                (0, -27, 0),
                "is under 0% of the organ and above 100% of it, .*expected under 50%",
            ),
            ((10, 60, 120), (32, 0, 0), "is under 0% of the organ and above 0%"),
            ((80, 10, 30), (0, 26, 40), r"is under \d\d?% of the organ.*expected under 50%"),
            ((80, 10, 120), (0, 40, 0), r"is 15\.[56] mm under the organ, .*expected at most 5 mm"),
            ((80, 10, 120), (0, 31, 0), r"is 6\.[56] mm under the organ"),
        ],
        ids=["in front", "beside it", "under one end", "far under it", "under it, not close"],
    )
    def test_elsewhere(self, tmp_path, organ, size, centre, words):
        with pytest.raises(PatientError, match=words) as caught:
            bed_of_file(self.file(tmp_path, slab(size, centre)), organ, SUPINE)
        assert "(0, 1, 0) in LPS" in str(caught.value) and "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("boxes", "words"),
        [
            # A pin touches the organ, and a slab is under all of it.
            ([((4, 14, 4), (0, 27.2, 0)), ((80, 10, 120), (0, 39, 0))], r"is 1[45]\.\d mm under the organ"),
            (
                [((80, 10, 120), (0, 26, 0)), ((80, 10, 120), (0, -45, 0))],
                "covers 100% of the organ from above.*expected at most 10%",
            ),
        ],
        ids=["pin", "cover"],
    )
    def test_two_bodies(self, tmp_path, organ, boxes, words):
        with pytest.raises(PatientError, match=words):
            bed_of_file(self.file(tmp_path, *(slab(*box) for box in boxes)), organ, SUPINE)

    def test_the_programs_own_supports(self, tmp_path, organ, monkeypatch):
        monkeypatch.setattr("scenes.patients.organ_support.GRID_MM", 2.0)
        for position in ("supine", "prone", "right-decubitus"):
            gravity = np.array(GRAVITY[position])
            mould(organ, gravity).export(tmp_path / "mould.stl")
            bed_of_file(tmp_path / "mould.stl", organ, gravity)

    def test_gaps_are_those_along_gravity(self, organ):
        """Under an ellipsoid, at a share s of its projected area, a plane d below is d + c (1 - sqrt(1 -
        s)) away.
        """
        bed = slab((120, 10, 120), (0, LEFT[1][1] + 2 + 5, 0))
        gaps, covered = vertical_gaps(bed, organ, SUPINE)
        shares = (np.arange(len(gaps)) + 0.5) / len(gaps)
        expected = 2 + LEFT[1][1] * (1 - np.sqrt(1 - shares))
        # The number of rays within an ellipse is its area's to about a ray in each row of 12; there are 22 mm
        # per share at most.
        inner = shares < 0.8
        assert len(gaps) > 150 and not covered.any()
        assert np.abs(np.sort(gaps) - expected)[inner].max() < 22 * 12 / len(gaps)

    def test_it_states_its_coordinate_system(self, tmp_path, organ):
        """In RAS, by the header of 3D Slicer."""
        bed = slab((80, 10, 120), (0, LEFT[1][1] + 6, 0))
        in_ras = trimesh.Trimesh(bed.vertices * [-1, -1, 1], bed.faces)
        (tmp_path / "bed.stl").write_bytes(
            b"SPACE=RAS".ljust(80, b"\0") + in_ras.export(file_type="stl")[80:]
        )
        read = bed_of_file(tmp_path / "bed.stl", organ, SUPINE)
        np.testing.assert_allclose(read.center_mass, bed.center_mass, atol=1e-3)
