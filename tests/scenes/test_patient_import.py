"""Patient import: a synthetic body whose organs are known in LPS mm."""

import re

import igl
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from synthetic_body import (
    DIRECTIONS,
    LEFT,
    RIGHT,
    TUMOUR,
    assert_sound,
    body,
    coarsely,
    drawn,
    least_gap,
    level,
    mapped,
    points_of,
    with_voxels,
)

import scenes.patients.patient_import
from errors import PatientError
from scenes.patients.check_picture import as_table, summary_rows
from scenes.patients.organ_selection import choose_organ, find_organs, midline_x
from scenes.patients.patient_folder import save_patient
from scenes.patients.patient_import import import_patient
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import LabelMap
from scenes.patients.readers.segment_choice import absent_labels, assign_tissues
from scenes.phantom import embedded_patient
from scenes.scene import SceneError
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import VoxelGrid

PELVIS = np.array([62.0, 35.0, 12.0]), np.array([8.0, 7.0, 12.0])
CYST = np.array([70.0, 20.0, -30.0]), np.array([12.0, 12.0, 12.0])  # sticks out, too
LIVER = np.array([20.0, 0.0, 40.0]), np.array([20.0, 20.0, 20.0])


def label_map(labels, organ=(), **tissues):
    """A label map with assigned tissues, and the values of its organ or None."""
    words = {tissue: [str(v) for v in values] for tissue, values in tissues.items()}
    (assigned,) = assign_tissues([LabelMap.of(labels)], [str(v) for v in organ], words)
    return assigned, list(organ) or None


def imported(ct, labels, organ=(), side=None, margin_mm=60.0, **tissues):
    labelled = label_map(labels, organ, **tissues)
    return import_patient(LazyVolume.of(ct), *labelled, side, margin_mm, assigned=tissues)


def organ_taken(ct, labels, organ=(), side=None, **tissues):
    """The organ that an import would take, and its side."""
    pieces = find_organs(*label_map(labels, organ, **tissues))
    midline = midline_x(VoxelGrid.of(ct), sitk.GetArrayFromImage(ct), -1000, 1000)
    return choose_organ(pieces, midline, side)


@pytest.fixture(scope="module")
def ct_and_labels():
    return body()


@pytest.fixture(scope="module")
def patient(ct_and_labels):
    return imported(*ct_and_labels, organ=[2], tumour=[3], margin_mm=20.0)


@pytest.fixture
def without_support(monkeypatch):
    """A mould takes a second, and is tested by itself."""
    monkeypatch.setattr(scenes.patients.patient_import, "_support", lambda kind, organ, *_: organ)


@pytest.fixture
def coarse(monkeypatch):
    coarsely(monkeypatch)


@pytest.mark.usefixtures("patient", "without_support")
class TestImport:
    def test_finds_the_organ(self, patient, ct_and_labels):
        ct, labels = ct_and_labels
        values = sitk.GetArrayViewFromImage(labels)
        voxel_ml = np.prod(ct.GetSpacing()) / 1000
        assert patient.side == "left"
        assert patient.volumes_ml["organ"] == pytest.approx((values >= 2).sum() * voxel_ml)
        assert patient.volumes_ml["tumour"] == pytest.approx((values == 3).sum() * voxel_ml)
        assert patient.organ.volume / 1000 == pytest.approx(patient.volumes_ml["organ"], rel=0.005)
        assert patient.tumour.volume / 1000 == pytest.approx(patient.volumes_ml["tumour"], rel=0.005)
        for mesh in (patient.organ, patient.tumour, patient.support):
            assert_sound(mesh)
        np.testing.assert_allclose(patient.tumour.center_mass, TUMOUR[0], atol=1.0)
        assert least_gap(patient.support, patient.organ) > 0
        assert patient.support.bounds[1, 1] > patient.organ.bounds[1, 1]  # posterior of it: supine
        text = as_table(summary_rows(patient))
        assert "left" in text and f"{patient.volumes_ml['organ']:.1f} ml" in text and "2.50" in text

    def test_crop_keeps_voxels_where_they_were(self, patient, ct_and_labels):
        assert patient.ct.GetPixelID() == sitk.sitkInt16 and patient.labels.GetPixelID() == sitk.sitkUInt8
        again = sitk.Resample(ct_and_labels[0], patient.ct, sitk.Transform(), sitk.sitkNearestNeighbor)
        assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(patient.ct))
        points, marked = points_of(patient.labels), sitk.GetArrayViewFromImage(patient.labels) > 0
        assert (points.reshape(-1, 3).min(axis=0) <= points[marked].min(axis=0) - 20).all()
        assert (points.reshape(-1, 3).max(axis=0) >= points[marked].max(axis=0) + 20).all()
        assert set(np.unique(sitk.GetArrayViewFromImage(patient.labels)).tolist()) == {0, 1, 2}
        assert not marked[points[..., 0] < 0].any()  # not the other kidney

    @pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
    @pytest.mark.parametrize(("value", "side"), [(1, "right"), (2, "left")])
    def test_tells_left_from_right(self, direction, value, side):
        ct, labels = body(direction, spacing=(4.0, 3.5, 5.0))
        assert organ_taken(ct, labels, [value])[1] == side
        both = organ_taken(ct, labels, side=side, tumour=[3] if value == 2 else [])[0]
        assert both.names[0] == str(value)
        only_one = mapped(labels, [0, value == 1, value == 2, value == 2])
        assert organ_taken(ct, only_one)[1] == side
        both_one_value = mapped(labels, [0, 1, 1, 1])
        organ, side_taken = organ_taken(ct, both_one_value, side=side)
        assert side_taken == side and np.sign(organ.centre_x_mm) == (1 if side == "left" else -1)
        with pytest.raises(PatientError, match="no (left|right) kidney"):
            organ_taken(ct, only_one, side="left" if side == "right" else "right")

    def test_parts_of_the_organ_keep_their_tissue(self, coarse, ct_and_labels):
        ct, labels = ct_and_labels
        voxels = drawn(labels, (2, LEFT), (3, TUMOUR), (7, PELVIS), (8, CYST), (9, LIVER))
        patient = imported(ct, voxels, [2], margin_mm=60.0, tumour=[3], urine=[7], cyst=[8], liver=[9])
        assert patient.tissues == {1: "kidney", 2: "tumour", 3: "cyst", 4: "liver", 5: "urine"}
        marks = sitk.GetArrayViewFromImage(patient.labels)
        places = points_of(patient.labels)
        for code, solid in ((2, TUMOUR), (3, CYST), (4, LIVER), (5, PELVIS)):
            inside = level(places, solid) < 0
            assert (marks[inside] == code).mean() > 0.95, code
        assert set(patient.parts) == {"tumour", "cyst", "urine"}
        for tissue, solid in (("tumour", TUMOUR), ("cyst", CYST), ("urine", PELVIS)):
            np.testing.assert_allclose(patient.parts[tissue].center_mass, solid[0], atol=1.5)
        # The cyst sticks out and is of the organ; the pelvis lies in it; the liver is another organ.
        centres = np.array([CYST[0], PELVIS[0], TUMOUR[0], LIVER[0]])
        faces = np.asarray(patient.organ.faces, np.int64)
        distance = igl.signed_distance(centres, np.asarray(patient.organ.vertices), faces)[0]
        assert (distance < 0).tolist() == [True, True, True, False]

    def test_cropped_ct_needs_the_side(self, ct_and_labels):
        ct, labels = ct_and_labels
        near = [slice(ct.TransformPhysicalPointToIndex((30.0, 0, 0))[0], None), slice(None), slice(None)]
        with pytest.raises(PatientError, match="--side left or --side right"):
            organ_taken(ct[near], labels[near], [2])
        assert organ_taken(ct[near], labels[near], [2], "left")[1] == "left"

    def test_names_tell_the_side_and_are_checked(self, coarse, ct_and_labels):
        ct, labels = ct_and_labels
        near = [slice(ct.TransformPhysicalPointToIndex((30.0, 0, 0))[0], None), slice(None), slice(None)]
        named = LabelMap.of(labels[near], {2: "kidney_left", 3: "kidney tumour"})
        assert import_patient(LazyVolume.of(ct[near]), named, margin_mm=10.0).side == "left"
        with pytest.raises(PatientError, match="has a name of the other side"):
            import_patient(LazyVolume.of(ct[near]), named, side="right", margin_mm=10.0)
        mirrored = LabelMap.of(labels, {1: "kidney_left", 2: "kidney_right", 3: "tumour"})
        with pytest.raises(PatientError, match="is on the patient's left, but its name has the other side"):
            import_patient(LazyVolume.of(ct), mirrored, side="left", margin_mm=10.0)
        other = LabelMap.of(labels, {1: "liver", 2: "spleen", 3: "stomach"})
        with pytest.raises(PatientError, match="no label is named as a kidney: 1 “liver”, 2 “spleen”"):
            import_patient(LazyVolume.of(ct), other)


def voxels_of(labels, value):
    """Number of voxels of a label, as ITK counts them."""
    counts = sitk.LabelStatisticsImageFilter()
    counts.Execute(labels, sitk.Cast(labels, sitk.sitkUInt8))
    return counts.GetCount(value)


@pytest.mark.usefixtures("without_support", "coarse")
class TestOneCommandForManyPatients:
    """KiTS: 1 = kidney, 2 = tumour, 3 = cyst, and not every patient has each of them."""

    @pytest.fixture
    def kits(self, ct_and_labels):
        """Both kidneys have label 1; the left one has a tumour."""
        return ct_and_labels[0], mapped(ct_and_labels[1], [0, 1, 1, 2])

    @pytest.mark.parametrize("organ", [[1], [1, 2]], ids=["organ 1", "organ 1,2"])
    def test_the_tumour_is_the_organs_however_it_is_given(self, kits, organ):
        patient = imported(*kits, organ, "left", 20.0, tumour=[2])
        voxel_ml = np.prod(kits[0].GetSpacing()) / 1000
        assert patient.volumes_ml["tumour"] == pytest.approx(voxels_of(kits[1], 2) * voxel_ml)
        assert patient.tissues[2] == "tumour" and (sitk.GetArrayViewFromImage(patient.labels) == 2).any()
        assert patient.notes[1:-1] == patient.warnings == ()
        # The left kidney's voxels, without the right kidney's.
        own = sitk.GetArrayViewFromImage(kits[1])[points_of(kits[1])[..., 0] > 0]
        assert patient.volumes_ml["organ"] == pytest.approx((own > 0).sum() * voxel_ml)

    def test_a_tumour_in_the_other_kidney(self, kits):
        patient = imported(*kits, [1, 2], "right", 20.0, tumour=[2])
        assert patient.tumour is None and all("is small" in text for text in patient.warnings)
        assert patient.notes[1:-1] == ("the tumour's label is only in the other kidney",)

    def test_a_tumour_apart_from_both_is_left_out_and_is_no_third_organ(self, kits):
        """Though it is as large as one."""
        apart = drawn(kits[1], (1, LEFT), (1, RIGHT), (2, (np.array([0, -30.0, 40]), np.full(3, 20.0))))
        patient = imported(kits[0], apart, [1, 2], "left", 20.0, tumour=[2])
        assert patient.tumour is None and patient.notes[1:-1] == ()
        (warning,) = patient.warnings
        assert "ml of the tumour's label touch no labelled kidney" in warning and "were left out" in warning

    def test_vessels_far_away(self, kits):
        far = drawn(kits[1], (1, LEFT), (2, TUMOUR), (4, (np.array([-40.0, 30, 0]), np.full(3, 9.0))))
        patient = imported(kits[0], far, [1], "left", 20.0, tumour=[2], artery=[4])
        assert patient.notes[1:-1] == ("the artery's label is more than 15 mm from this kidney",)

    def test_a_label_that_no_voxel_has(self, kits):
        """A note from the words, not from the voxels of one kidney."""
        maps = [LabelMap.of(kits[1])]
        chosen = {"tumour": ["2"], "cyst": ["3", "4"]}
        (assigned,) = assign_tissues(maps, ["1", "2"], chosen)
        assert [s.tissue for s in assigned.segments.values()] == ["kidney", "tumour"]
        assert absent_labels(maps, chosen) == (
            "no voxel has the cyst's label 3",
            "no voxel has the cyst's label 4",
        )
        assert absent_labels(maps, {"tumour": ["2"]}) == ()
        # As the option names it.
        assert absent_labels(maps, {"urine": ["5"]}) == ("no voxel has the collecting system's label 5",)
        # The organ's own label must be there, but not the tumour's, of those that are given as both.
        (healthy,) = assign_tissues([LabelMap.of(mapped(kits[1], [0, 1, 0]))], ["1", "2"], {"tumour": ["2"]})
        assert list(healthy.segments) == [1]


class TestImportRefuses:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({}, r"2 organs .*label 1, right, \d+\.\d ml; label 2\+3, left, \d+\.\d ml.*--side"),
            ({"organ": [5]}, "label 5 is not in the label map: it has 1, 2, 3; give one of these"),
            (
                {"organ": [3], "tumour": [3]},
                "labels are only those of tumours and cysts; give the kidney's own",
            ),
            ({"organ": [1, 5], "tumour": [3]}, "the organ's label 5 is not in the label map"),
            ({"tumour": ["mass"], "organ": [1]}, "the tumour's label mass is not in the label map"),
            ({"organ": [1], "side": "left"}, "no left kidney is labelled, found: label 1, right"),
            ({"organ": [3]}, r"has 5\.\d ml: expected 20 to 2000 ml"),
            ({"organ": [2], "margin_mm": -1.0}, "margin"),
        ],
    )
    def test_options(self, ct_and_labels, options, words):
        with pytest.raises(PatientError, match=words) as caught:
            imported(*ct_and_labels, **options)
        assert "\n" not in str(caught.value)

    def test_labels_that_are_none(self, ct_and_labels):
        ct, labels = ct_and_labels
        with pytest.raises(PatientError, match="empty"):
            imported(ct, labels * 0)
        with pytest.raises(PatientError, match="exchanged"):
            imported(labels, ct)
        with pytest.raises(PatientError, match="whole numbers"):
            imported(ct, sitk.Cast(labels, sitk.sitkFloat32) * 0.3)
        with pytest.raises(PatientError, match="no organ, only 3; expected a kidney too"):
            imported(ct, mapped(labels, [0, 0, 0, 3]), tumour=[3])

    def test_labels_of_another_place(self, ct_and_labels):
        ct, labels = ct_and_labels
        far = sitk.Image(labels)
        far.SetOrigin((1000.0, 0.0, 0.0))
        with pytest.raises(PatientError, match="outside the CT, with 0 %"):
            imported(ct, far)
        half = sitk.Image(labels)
        half.SetOrigin(np.add(labels.GetOrigin(), (0, 0, 80.0)).tolist())
        with pytest.raises(PatientError, match=r"has \d\d% of its voxels in the CT"):
            imported(ct, half, [2], "left")

    @pytest.mark.parametrize(("z", "end"), [((-90.0, 20.0), -1), ((-20.0, 90.0), 0)])
    def test_organ_cut_off(self, z, end):
        """Over the section of the ellipsoid in the last slice, 4 mm thick, of pixels of 3 x 2.5 mm."""
        ct, labels = body(z=z)
        height = (points_of(labels)[end, 0, 0, 2] - LEFT[0][2]) / LEFT[1][2]
        whole = np.pi * LEFT[1][0] * LEFT[1][1] * (1 - height**2) / 100
        with pytest.raises(PatientError, match="cut off at the border") as caught:
            imported(ct, labels, organ=[2])
        cm2 = float(re.search(r"over ([\d.]+) cm2", str(caught.value))[1])
        # The tumour, a ball of 11 mm, takes a part of the upper one.
        part = sitk.GetArrayFromImage(labels)[end] == 2
        assert cm2 == pytest.approx(part.sum() * 7.5 / 100, abs=0.06) and 0.6 * whole < cm2 < 1.04 * whole

    def test_implausible_organ(self, ct_and_labels):
        ct, labels = ct_and_labels
        everything = with_voxels(labels, (sitk.GetArrayViewFromImage(ct) > -500).astype(np.int16))
        with pytest.raises(PatientError, match="expected 20 to 2000 ml"):
            imported(ct, everything, side="left")

    def test_organ_that_is_no_soft_tissue(self, ct_and_labels):
        ct, labels = ct_and_labels
        with pytest.raises(PatientError, match="soft tissue"):
            imported(ct + 800, labels, organ=[2])


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
            again, image = open_ct(folder / f"{name}.nrrd").image(), getattr(patient, name)
            assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(image))
            np.testing.assert_allclose(again.GetOrigin(), image.GetOrigin(), atol=1e-6)
            np.testing.assert_allclose(again.GetDirection(), image.GetDirection(), atol=1e-9)
        organ = trimesh.load(folder / "organ.stl")
        assert organ.is_watertight and organ.volume == pytest.approx(patient.organ.volume, rel=1e-5)
        # Without it 3D Slicer takes a surface's coordinates for RAS.
        assert all(file.read_bytes().startswith(b"SPACE=LPS") for file in folder.glob("*.stl"))
        for file in folder.iterdir():
            content = file.read_bytes()
            assert b"Doe" not in content and str(tmp_path).encode() not in content

    @pytest.mark.parametrize("fault", [(28, "No space"), ("broken picture",)])
    def test_interrupted_leaves_nothing(self, patient, tmp_path, fault):
        def full(_folder):
            raise OSError(*fault)

        with pytest.raises(PatientError, match="(No space|cannot be written); choose a folder"):
            save_patient(patient, tmp_path / "patient", draw=full)
        assert list(tmp_path.iterdir()) == []

    def test_a_full_disk_is_reported_and_leaves_nothing(self, patient, tmp_path, bytes_to_a_file):
        with bytes_to_a_file(100), pytest.raises(PatientError, match="is the disk full.*; choose a folder"):
            save_patient(patient, tmp_path / "patient")
        assert list(tmp_path.iterdir()) == []

    def test_the_embedded_patient_is_saved_where_it_can_be(self, patient, tmp_path, monkeypatch):
        monkeypatch.setattr(embedded_patient, "make_embedded_patient", lambda progress: patient)
        monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "temporary"))
        cache = tmp_path / "cache"
        cache.write_text("a file in the way")
        monkeypatch.setattr(embedded_patient, "CACHE", cache)
        folder = embedded_patient.phantom_folder()
        assert folder.parent == tmp_path / "temporary" / "nephron" and (folder / "organ.stl").is_file()
        monkeypatch.setattr(
            embedded_patient, "make_embedded_patient", lambda progress: pytest.fail("made twice")
        )
        assert embedded_patient.phantom_folder() == folder
        monkeypatch.setattr(embedded_patient, "make_embedded_patient", lambda progress: patient)
        monkeypatch.setattr("tempfile.gettempdir", lambda: str(cache))
        with pytest.raises(SceneError, match="can be written to neither; free"):
            embedded_patient.phantom_folder()


@pytest.mark.usefixtures("patient", "without_support", "coarse")
class TestWarnings:
    """What looks wrong gives warnings, and the import continues."""

    def test_a_body_as_it_should_be(self, patient):
        assert patient.warnings == ()
        position, phase = patient.notes
        assert position.startswith("assumed supine")
        assert phase.startswith("contrast phase: enhanced, as the kidney has a median of 120 HU")

    # Of both warnings of one cause that is given which says more; beyond its reach the rim of fat remains.
    @pytest.mark.parametrize(
        ("back_mm", "words"),
        [(0.0, []), (6.0, ["when moved by 6 mm to the front"]), (11.0, ["rim is fat or gas"])],
    )
    def test_labels_shifted_into_fat(self, ct_and_labels, back_mm, words):
        ct, labels = ct_and_labels
        voxels = sitk.GetArrayFromImage(ct)
        voxels[voxels == 40] = -100
        shifted = sitk.Image(labels)
        shifted.SetOrigin(np.add(labels.GetOrigin(), (0, back_mm, 0)).tolist())
        lines = imported(with_voxels(ct, voxels), shifted, [2], margin_mm=20.0, tumour=[3]).warnings
        assert len(lines) == len(words) and all(word in line for word, line in zip(words, lines, strict=True))

    def test_contrast_agent_in_the_kidney(self, ct_and_labels):
        """How much of it, on a finer grid: test_dense_findings.py."""
        ct, labels = ct_and_labels
        voxels = sitk.GetArrayFromImage(ct)
        voxels[level(points_of(ct), (LEFT[0] + [0, 0, 25], np.full(3, 6.0))) < 0] = 500
        (warning,) = imported(with_voxels(ct, voxels), labels, [2], margin_mm=20.0, tumour=[3]).warnings
        assert "(--stones)" in warning and "120 HU: enhanced" in warning

    def test_a_label_that_is_no_whole_kidney(self, ct_and_labels):
        """Hollow, and cut off above."""
        ct, labels = ct_and_labels
        points, marks = points_of(ct), sitk.GetArrayFromImage(labels)
        marks[(level(points, (LEFT[0], LEFT[1] - [9, 9, 18])) < 0) | (points[..., 2] > LEFT[0][2] + 30)] = 0
        small, hollow, flat = imported(
            ct, with_voxels(labels, marks), [2], margin_mm=20.0, tumour=[3]
        ).warnings
        assert "the kidney is small" in small and "label is hollow: it has" in hollow
        assert "towards the head in a flat face" in flat

    def test_labels_without_a_meaning(self, ct_and_labels):
        (warning,) = imported(*ct_and_labels, side="left", margin_mm=20.0).warnings
        assert "labels 2, 3 have no names, and were all taken as the kidney" in warning
        (warning,) = imported(*ct_and_labels, organ=[2], margin_mm=20.0).warnings
        assert (
            "label 3 (5." in warning
            and "in the organ has no known tissue" in warning
            and "--tumour" in warning
        )


def test_what_touches_by_a_corner_is_held_and_what_only_touches_is_no_part(ct_and_labels, without_support):
    """Of two organs that touch by a corner neither is the other's, but a tumour that does is the kidney's."""
    ct, _ = ct_and_labels
    grid = VoxelGrid.of(ct)
    values = np.zeros(grid.size[::-1], np.uint8)
    x, y, z = (int(n) for n in grid.index(LEFT[0][None])[0])
    values[z - 8 : z + 8, y - 8 : y + 8, x - 8 : x + 8] = 1
    values[z + 8 : z + 13, y + 8 : y + 13, x + 8 : x + 13] = 2
    apart = find_organs(LabelMap.valued(grid, values), [1, 2])
    assert [piece.mask.sum() for piece in apart] == [16**3]
    label = LabelMap.valued(grid, values, {1: "kidney", 2: "tumour"})
    (piece,) = find_organs(label)
    assert 16**3 + 5**3 < piece.mask.sum() <= 16**3 + 5**3 + 8
    patient = import_patient(LazyVolume.of(ct), label, side="left", margin_mm=10.0)
    assert patient.organ.body_count == 1
    assert patient.organ.volume / 1000 == pytest.approx(patient.volumes_ml["organ"], rel=0.02)
