"""Patient import: a synthetic body whose organs are known in LPS mm, and the real data."""

from pathlib import Path

import igl
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from synthetic_body import (
    DIRECTIONS,
    LEFT,
    LEFT_ML,
    RIGHT,
    TUMOUR,
    assert_sound,
    body,
    drawn,
    grid_around,
    least_gap,
    mapped,
    points_of,
    voxels_to_boundary,
    with_voxels,
)

from scenes.patient import PatientError, describe, import_patient, read_volume, save_patient
from scenes.support import cradle

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="module")
def ct_and_labels():
    return body()


@pytest.fixture(scope="module")
def patient(ct_and_labels):
    return import_patient(*ct_and_labels, organ=[2], tumour=[3], margin_mm=20.0)


class TestImport:
    def test_finds_the_organ(self, patient, ct_and_labels):
        ct, labels = ct_and_labels
        values = sitk.GetArrayViewFromImage(labels)
        voxel_ml = np.prod(ct.GetSpacing()) / 1000
        assert patient.side == "left"
        assert patient.organ_volume_ml == pytest.approx((values >= 2).sum() * voxel_ml)
        assert patient.tumour_volume_ml == pytest.approx((values == 3).sum() * voxel_ml)
        assert patient.organ.volume / 1000 == pytest.approx(patient.organ_volume_ml, rel=0.005)
        assert patient.tumour.volume / 1000 == pytest.approx(patient.tumour_volume_ml, rel=0.005)
        for mesh in (patient.organ, patient.tumour, patient.support):
            assert_sound(mesh)
        np.testing.assert_allclose(patient.tumour.center_mass, TUMOUR[0], atol=1.0)
        assert least_gap(patient.support, patient.organ) > 0
        assert patient.support.bounds[1, 1] > patient.organ.bounds[1, 1]  # posterior of it: supine
        text = describe(patient)
        assert "left" in text and f"{patient.organ_volume_ml:.1f} ml" in text and "2.50" in text

    def test_crop_keeps_voxels_where_they_were(self, patient, ct_and_labels):
        assert patient.ct.GetPixelID() == sitk.sitkInt16 and patient.labels.GetPixelID() == sitk.sitkUInt8
        again = sitk.Resample(ct_and_labels[0], patient.ct, sitk.Transform(), sitk.sitkNearestNeighbor)
        assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(patient.ct))
        points, marked = points_of(patient.labels), sitk.GetArrayViewFromImage(patient.labels) > 0
        assert (points.reshape(-1, 3).min(axis=0) <= points[marked].min(axis=0) - 20).all()
        assert (points.reshape(-1, 3).max(axis=0) >= points[marked].max(axis=0) + 20).all()
        assert set(np.unique(sitk.GetArrayViewFromImage(patient.labels)).tolist()) == {0, 1, 2}

    @pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
    @pytest.mark.parametrize(("value", "side"), [(1, "right"), (2, "left")])
    def test_tells_left_from_right(self, direction, value, side):
        from scenes.labels import labelled_organ

        ct, labels = body(direction, spacing=(4.0, 3.5, 5.0))
        assert labelled_organ(ct, labels, [value], None, None)[1] == side
        assert labelled_organ(ct, labels, None, [3] if value == 2 else None, side)[0].values == [value]
        only_one = mapped(labels, [0, value == 1, value == 2, value == 2])
        assert labelled_organ(ct, only_one, None, None, None)[1] == side
        both_one_value = mapped(labels, [0, 1, 1, 1])
        organ, told = labelled_organ(ct, both_one_value, None, None, side)
        assert told == side and np.sign(organ.centre_x_mm) == (1 if side == "left" else -1)
        with pytest.raises(PatientError, match="no (left|right) kidney"):
            labelled_organ(ct, only_one, None, None, "left" if side == "right" else "right")

    def test_parts_of_the_organ_keep_their_tissue(self, ct_and_labels):
        ct, labels = ct_and_labels
        values = sitk.GetArrayFromImage(labels).astype(np.int16)
        kidney = np.argwhere(values == 2)
        values[tuple(kidney[len(kidney) // 2])] = 7
        found = import_patient(
            ct, with_voxels(labels, values), [2, 7], [3], margin_mm=20.0, tissues={7: "urine"}
        )
        assert found.tissues == {1: "kidney", 2: "tumour", 3: "urine"}
        assert (sitk.GetArrayViewFromImage(found.labels) == 3).sum() == 1

    def test_labels_on_another_grid(self, ct_and_labels):
        from scenes.labels import labelled_organ

        ct, _ = ct_and_labels
        finer = drawn(grid_around((-110, -20, -70), (120, 80, 80), (2.0, 2.0, 2.0)), (1, RIGHT), (2, LEFT))
        organ, side = labelled_organ(ct, finer, [2], None, None)
        assert side == "left" and organ.mask.shape == ct.GetSize()[::-1]
        assert organ.volume_ml == pytest.approx(LEFT_ML, rel=0.03)

    def test_padding_becomes_air(self, ct_and_labels):
        ct, labels = ct_and_labels
        voxels = sitk.GetArrayFromImage(ct)
        voxels[voxels == -1000] = -3024
        import scenes.patient as module

        organ, _ = module.labelled_organ(with_voxels(ct, voxels), labels, [2], [3], None)
        cropped, marked = module._crop(with_voxels(ct, voxels), organ, 300.0, {})
        assert sitk.GetArrayViewFromImage(cropped).min() == -1000
        assert not sitk.GetArrayViewFromImage(marked)[
            points_of(marked)[..., 0] < 0
        ].any()  # not the other kidney

    def test_cropped_ct_needs_the_side(self, ct_and_labels):
        from scenes.labels import labelled_organ

        ct, labels = ct_and_labels
        near = [slice(ct.TransformPhysicalPointToIndex((30.0, 0, 0))[0], None), slice(None), slice(None)]
        with pytest.raises(PatientError, match="--side left or --side right"):
            labelled_organ(ct[near], labels[near], [2], None, None)
        assert labelled_organ(ct[near], labels[near], [2], None, "left")[1] == "left"


class TestImportRefuses:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({}, r"2 organs .*label 1, right, \d+\.\d ml; label 2\+3, left, \d+\.\d ml.*--side"),
            ({"organ": [5]}, "label 5 is not in the label map: it holds 1, 2, 3; give --organ"),
            ({"organ": []}, "none given"),
            ({"tumour": [8], "organ": [1]}, "tumour's label 8 is not"),
            ({"organ": [1, 3], "tumour": [3]}, "label 3 is given as organ and as tumour"),
            ({"organ": [1], "tumour": [3]}, "no voxel in the right kidney"),
            ({"organ": [1], "side": "left"}, "no left kidney is labelled, found: label 1, right"),
            ({"organ": [1], "side": "up"}, "expected left or right"),
            ({"organ": [3]}, r"has 5\.\d ml: expected 20 to 2000 ml"),
            ({"organ": [2], "margin_mm": -1.0}, "margin"),
        ],
    )
    def test_options(self, ct_and_labels, options, words):
        with pytest.raises(PatientError, match=words) as caught:
            import_patient(*ct_and_labels, **options)
        assert "\n" not in str(caught.value)

    def test_labels_that_are_none(self, ct_and_labels):
        ct, labels = ct_and_labels
        with pytest.raises(PatientError, match="empty"):
            import_patient(ct, labels * 0)
        with pytest.raises(PatientError, match="swapped"):
            import_patient(labels, ct)
        with pytest.raises(PatientError, match="whole numbers"):
            import_patient(ct, sitk.Cast(labels, sitk.sitkFloat32) * 0.3)
        with pytest.raises(PatientError, match="the tumour's label alone"):
            import_patient(ct, mapped(labels, [0, 0, 0, 3]), tumour=[3])

    def test_labels_of_another_place(self, ct_and_labels):
        ct, labels = ct_and_labels
        far = sitk.Image(labels)
        far.SetOrigin((1000.0, 0.0, 0.0))
        with pytest.raises(PatientError, match="outside the CT"):
            import_patient(ct, far)

    def test_organ_cut_off(self):
        ct, labels = body(z=(-90.0, 20.0))
        with pytest.raises(PatientError, match="cut off at the border"):
            import_patient(ct, labels, organ=[2])

    def test_implausible_organ(self, ct_and_labels):
        ct, labels = ct_and_labels
        everything = with_voxels(labels, (sitk.GetArrayViewFromImage(ct) > -500).astype(np.int16))
        with pytest.raises(PatientError, match="expected 20 to 2000 ml"):
            import_patient(ct, everything, side="left")

    def test_organ_that_is_no_soft_tissue(self, ct_and_labels):
        ct, labels = ct_and_labels
        with pytest.raises(PatientError, match="soft tissue"):
            import_patient(ct + 1024, labels, organ=[2])


class TestSave:
    def test_writes_what_was_imported_and_nothing_of_the_source(self, patient, tmp_path):
        named = sitk.Image(patient.ct)
        named.SetMetaData("0010|0010", "Doe^Jane")
        object.__setattr__(patient, "ct", named)
        folder = tmp_path / "new" / "patient"
        save_patient(patient, folder, texts={"scene.toml": "a = 1\n"})

        names = {file.name for file in folder.iterdir()}
        assert names == {"ct.nrrd", "labels.nrrd", "organ.stl", "tumour.stl", "support.stl", "scene.toml"}
        assert [entry.name for entry in folder.parent.iterdir()] == ["patient"]
        for name in ("ct", "labels"):
            again, image = read_volume(folder / f"{name}.nrrd"), getattr(patient, name)
            assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(image))
            np.testing.assert_allclose(again.GetOrigin(), image.GetOrigin(), atol=1e-6)
            np.testing.assert_allclose(again.GetDirection(), image.GetDirection(), atol=1e-9)
        organ = trimesh.load(folder / "organ.stl")
        assert organ.is_watertight and organ.volume == pytest.approx(patient.organ.volume, rel=1e-5)
        for file in folder.iterdir():
            content = file.read_bytes()
            assert b"Doe" not in content and str(tmp_path).encode() not in content

    def test_leaves_what_is_there(self, patient, tmp_path):
        (tmp_path / "precious.txt").write_text("mine")
        with pytest.raises(PatientError, match="not an empty folder"):
            save_patient(patient, tmp_path)
        with pytest.raises(PatientError, match="not an empty folder"):
            save_patient(patient, tmp_path / "precious.txt")
        assert [entry.name for entry in tmp_path.iterdir()] == ["precious.txt"]

    def test_interrupted_leaves_nothing(self, patient, tmp_path, monkeypatch):
        monkeypatch.setattr(
            trimesh.Trimesh, "export", lambda *_: (_ for _ in ()).throw(OSError(28, "No space"))
        )
        with pytest.raises(PatientError, match="No space"):
            save_patient(patient, tmp_path / "patient")
        assert list(tmp_path.iterdir()) == []


REAL = [
    ("crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", 1, "right", 108.8),
    ("crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz", 2, "left", 125.6),
    ("totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 1, "left", 138.9),
    ("totalseg/ct.nii.gz", "totalseg/kidneys.nii.gz", 2, "right", 188.8),
]


@pytest.mark.skipif(not (DATA / "ct").is_dir(), reason="real data (../shared/data/ct) is not here")
class TestRealData:
    @pytest.mark.parametrize(("ct", "labels", "value", "side", "volume_ml"), REAL)
    def test_kidney(self, ct, labels, value, side, volume_ml):
        ct, labels = read_volume(DATA / "ct" / ct), read_volume(DATA / "ct" / labels)
        patient = import_patient(ct, labels, organ=[value])
        assert patient.side == side
        assert patient.organ.volume / 1000 == pytest.approx(volume_ml, rel=0.01)
        assert len(patient.organ.faces) == pytest.approx(5000, abs=20)
        assert_sound(patient.organ)
        assert_sound(patient.support)
        assert voxels_to_boundary(patient.organ, labels == value).max() < 1
        assert least_gap(patient.support, patient.organ) > 0
        assert sitk.GetArrayViewFromImage(patient.ct).min() >= -1024

    def test_series_that_must_be_refused(self):
        failing = DATA / "dicom" / "dicom2nifti" / "tests" / "data" / "failing"
        if not failing.is_dir():
            pytest.skip("../shared/data/dicom is not here")
        folders = {file.parent for file in failing.rglob("*") if file.is_file()}
        for folder in sorted(folders):
            with pytest.raises(PatientError):
                read_volume(folder)


@pytest.mark.skipif(
    not (DATA / "truth").is_dir(), reason="bead experiments (../shared/data/truth) are not here"
)
@pytest.mark.parametrize("case", ["bean", "kits040"])
def test_support_like_that_of_the_bead_experiments(case):
    organ = trimesh.load(DATA / "truth" / case / "kidney.stl")
    expected = trimesh.load(DATA / "truth" / case / "support.stl")
    support = cradle(organ, np.array([0.0, 0.0, -1.0]))
    assert_sound(support)
    np.testing.assert_allclose(support.bounds[:, 2], expected.bounds[:, 2], atol=0.1)
    # The mould itself: organ's underside, away from the rim, as far from our support as from theirs.
    low, high = organ.bounds[:, 2]
    under = organ.vertices[organ.vertices[:, 2] < low + 0.2 * (high - low)]
    gaps = [
        igl.signed_distance(
            np.ascontiguousarray(under), np.asarray(m.vertices), np.asarray(m.faces, np.int64)
        )[0]
        for m in (support, expected)
    ]
    assert np.abs(gaps[0] - gaps[1]).mean() < 0.1
