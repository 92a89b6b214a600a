"""Supports other than the mould: a bed of labels, a surface of the user's own."""

import igl
import numpy as np
import pytest
import trimesh
from synthetic_body import LEFT, TUMOUR, assert_sound, body, coarsely, drawn, grid_around, least_gap, level

from errors import PatientError
from scenes.patients.organ_support import bed_of_file, bed_of_labels
from scenes.patients.patient_import import SUPINE_GRAVITY, import_patient
from scenes.patients.readers.label_maps import LabelMap
from scenes.volumes.lazy_volume import LazyVolume

# A muscle behind the left kidney, with 4 mm of fat between.
MUSCLE = np.array([70.0, 79.0, 12.0]), np.array([45.0, 20.0, 70.0])
NAMES = {2: "kidney_left", 3: "tumour", 4: "psoas"}
SMALL = np.array([10.0, -20.0, 30.0]), np.array([13.0, 11.0, 18.0])


def small_organs_bed(muscle: tuple[np.ndarray, np.ndarray]) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """An organ that is soon made, and the bed of a muscle."""
    organ = trimesh.creation.icosphere(subdivisions=3)
    organ.vertices = organ.vertices * SMALL[1] + SMALL[0]
    empty = grid_around(SMALL[0] - 50, SMALL[0] + 50, (2.5, 2.5, 2.5))
    labels = LabelMap.of(drawn(empty, (4, muscle), (2, SMALL)), NAMES)
    return organ, bed_of_labels(organ, labels, [2, 3], SUPINE_GRAVITY)


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
        behind = LEFT[0] + np.outer(LEFT[1][1] + np.array([-1.0, 1.5, 4.0, 15.0]), SUPINE_GRAVITY)
        faces = np.asarray(patient.support.faces, np.int64)
        distance = igl.signed_distance(behind, np.asarray(patient.support.vertices), faces)[0]
        assert (distance < 0).tolist() == [False, True, True, True]

    def test_beside_the_organ_it_is_the_muscle(self, patient):
        """Away from the organ, within the bed's reach, vertices lie on the muscle or on the bed's own ends."""
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
        slab = trimesh.creation.box([80.0, 10.0, 120.0])
        slab.apply_translation([70.0, LEFT[0][1] + LEFT[1][1] + 6.0, 12.0])
        slab.export(tmp_path / "slab.stl")
        again = import_patient(
            ct, LabelMap.of(labels, NAMES), margin_mm=10.0, support=str(tmp_path / "slab.stl")
        )
        np.testing.assert_allclose(again.support.bounds, slab.bounds, atol=1e-4)
        assert np.array_equal(again.organ.vertices, patient.organ.vertices)

    def test_what_is_no_support(self, patient, tmp_path):
        inside, far, open_ = (trimesh.creation.box([40.0, 40.0, 40.0]) for _ in range(3))
        inside.apply_translation(LEFT[0])
        far.apply_translation([-300.0, 0, 0])
        open_.apply_translation(LEFT[0] + [0, 60, 0])
        open_.update_faces(np.arange(len(open_.faces)) > 0)
        for name, mesh in (("inside", inside), ("far", far), ("open", open_)):
            mesh.export(tmp_path / f"{name}.stl")
        (tmp_path / "text.stl").write_text("no surface")
        for name, words in [
            ("inside", "mm into the organ"),
            ("far", "mm from the organ"),
            ("open", "not a closed surface"),
            ("text", "has no triangles"),
            ("absent", "no such file"),
        ]:
            with pytest.raises(PatientError, match=words) as caught:
                bed_of_file(tmp_path / f"{name}.stl", patient.organ)
            assert "\n" not in str(caught.value) and f"{name}.stl" in str(caught.value)


def test_a_surface_that_faces_inward(tmp_path):
    ball = trimesh.creation.icosphere(radius=20.0)
    ball.apply_translation(LEFT[0])
    box = trimesh.creation.box([40.0, 10.0, 40.0])
    box.apply_translation(LEFT[0] + [0, 26, 0])
    box.invert()
    box.export(tmp_path / "in.stl")
    with pytest.raises(PatientError, match="faces outward"):
        bed_of_file(tmp_path / "in.stl", ball)
