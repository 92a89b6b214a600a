"""Labels as they come: every voxel that was marked, in its place, under its name, and no other."""

import shutil
from dataclasses import replace

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_series import Series, refusal, write_segmentation, write_structures, zipped
from raw_nrrd import segment_lines, write_nrrd
from scipy.spatial.transform import Rotation
from synthetic_body import DIRECTIONS, drawn, grid_around, level

from errors import PatientError
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_maps import LabelMap, Segment
from scenes.patients.readers.label_merge import merge_label_maps
from scenes.patients.readers.segment_choice import assign_tissues
from scenes.patients.readers.segment_names import is_far, side_of, tissue_of
from scenes.volumes.voxel_grid import VoxelGrid

NAMES = {
    "kidney_left": ("kidney", "left"), "kidney_right": ("kidney", "right"), "Kidney L": ("kidney", "left"),
    "Left Kidney": ("kidney", "left"), "Right_Kidney_1": ("kidney", "right"), "kidneyR": ("kidney", "right"),
    "Rt Kidney": ("kidney", "right"), "Kidneys": ("kidney", None), "both kidneys": ("kidney", None),
    "left and right kidney": ("kidney", None),
    "Niere links": ("kidney", "left"), "Niere rechts": ("kidney", "right"), "Rein gauche": ("kidney", "left"),
    "left renal mass": ("tumour", "left"), "GTV": ("tumour", None), "GTV_L": ("tumour", "left"),
    "Renal Tumor": ("tumour", None), "tumour": ("tumour", None), "ccRCC right": ("tumour", "right"),
    "Tumor Niere links": ("tumour", "left"), "kidney_lesion": ("tumour", None),
    "kidney_cyst_left": ("cyst", "left"),
    "Renal cyst": ("cyst", None), "adrenal_gland_left": (None, "left"), "gallbladder": (None, None),
    "renal vein left": ("vein", "left"), "Renal artery R": ("artery", "right"), "aorta": ("artery", None),
    "renal arteries and veins": ("vessel", None), "blood vessels": ("vessel", None),
    "inferior_vena_cava": ("vein", None), "ureter_right": ("urine", "right"), "Renal pelvis": ("urine", None),
    "renal_cortex": ("cortex", None), "renal sinus fat": ("sinus", None), "liver": ("liver", None),
    "rib_left_11": ("bone", "left"), "vertebrae_L1": ("bone", None), "hip_left": ("bone", "left"),
    "spleen": ("spleen", None), "Segment_1": (None, None), "colon": (None, None),
    "iliopsoas_right": ("muscle", "right"),
}  # fmt: skip
KIDNEY = np.array([-28.0, 24.0, -393.0]), np.array([3.0, 2.5, 5.0])
TUMOUR = np.array([-26.5, 24.5, -391.0]), np.array([1.6, 1.4, 2.6])
ENDINGS = [".nii.gz", ".nii", ".nrrd", ".mha"]
SEGMENTS = [
    dict(Name="Kidney L", LabelValue=1, Layer=0, Color="0.5 0.25 1", Extent="0 3 0 3 0 3", ID="Segment_1"),
    dict(Name="renal mass", LabelValue=1, Layer=1, Color="1 0 0"),
    dict(Name="aorta", LabelValue=2, Layer=0, Color="0 0 1"),
]


def ct_grid(series):
    """The voxels of a series in the order of its slices."""
    spacing = np.array([*series.spacing, series.gap])
    return VoxelGrid(series.size, spacing, series.origin, series.direction)


def on(grid, label_map, value):
    """Where a value is marked, on the voxels (z, y, x) of a grid that its own are a part of."""
    marked = np.argwhere(label_map.values == value)[:, ::-1]
    index = grid.index(label_map.grid.place(marked))
    at = np.rint(index).astype(int)
    np.testing.assert_allclose(index, at, atol=2e-3)
    labelled = np.zeros(grid.size[::-1], bool)
    labelled[tuple(at.T[::-1])] = True
    assert labelled.sum() == len(marked)
    return labelled


def by_name(maps, grid=None):
    return {s.name: on(grid or one.grid, one, v) for one in maps for v, s in one.segments.items()}


def solid(series, shape):
    return level(np.stack([series.places(k) for k in range(series.size[2])]), shape) < 0


@pytest.fixture(params=["identity", "oblique", "left-handed", "slices first"])
def series(request, tmp_path):
    """A CT around both solids; slices first: none of its axes is the patient's."""
    direction = DIRECTIONS[request.param]
    size = np.array([22, 20, 9])
    origin = KIDNEY[0] - direction @ ((size - 1) / 2 * (0.8, 0.7, 2.5))
    made = Series(tmp_path / "ct", direction, size=tuple(size.tolist()), origin=origin)
    made.write()
    return made


class TestNames:
    @pytest.mark.parametrize("name", NAMES)
    def test_tissue_and_side(self, name):
        assert (tissue_of(name), side_of(name)) == NAMES[name]

    def test_far_organs(self):
        near = [
            "kidney_left",
            "liver",
            "rib_left_11",
            "rib_right_12",
            "vertebrae_T12",
            "vertebrae_L1",
            "spleen",
        ]
        near += [
            "kidney_left_surface",
            "Interface",
            "iliopsoas_left",
            "aorta",
            "colon",
            "renal_lesion",
            "autochthon_right",
            "stomach",
        ]
        far = [
            "face",
            "brain",
            "heart",
            "lung_upper_lobe_left",
            "rib_left_3",
            "vertebrae_C5",
            "vertebrae_T4",
            "femur_left",
        ]
        far += ["urinary_bladder", "prostate", "gluteus_maximus_left", "skull", "trachea"]
        assert [name for name in near if is_far(name)] == [] and all(is_far(name) for name in far)


class TestLabelMaps:
    @pytest.mark.parametrize("ending", ENDINGS)
    @pytest.mark.parametrize("kind", [sitk.sitkUInt8, sitk.sitkInt16, sitk.sitkFloat32, sitk.sitkFloat64])
    @pytest.mark.parametrize("direction", ["oblique", "left-handed"])
    def test_own_grid(self, tmp_path, ending, kind, direction):
        empty = grid_around((-33, 18, -401), (-22, 30, -385), (0.7, 0.9, 1.6), DIRECTIONS[direction])
        labels = drawn(empty, (1, KIDNEY), (7, TUMOUR))
        sitk.WriteImage(sitk.Cast(labels, kind), str(tmp_path / f"a{ending}"))
        (one,) = open_labels(tmp_path / f"a{ending}").maps(None)
        assert set(one.segments) == {1, 7} and one.grid.same_as(VoxelGrid.of(labels))
        assert np.array_equal(one.values, sitk.GetArrayFromImage(labels))

    @pytest.mark.parametrize(
        ("voxels", "words"),
        [
            (np.full((4, 4, 4), 0.5, np.float32), "probability"), (np.zeros((4, 4, 4), np.uint8), "is empty"),
            (np.full((4, 4, 4), -1000, np.int16), "exchanged"),
            (np.full((4, 4, 4), 70_000, np.int32), "whole numbers"),
            (np.full((4, 4, 4), np.nan, np.float32), "finite"),
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("ending", [".nii.gz", ".nrrd"])
    def test_no_labels(self, tmp_path, voxels, words, ending):
        sitk.WriteImage(sitk.GetImageFromArray(voxels), str(tmp_path / f"a{ending}"))
        assert words in refusal(tmp_path / f"a{ending}", read=lambda path: open_labels(path).maps(None))

    @pytest.fixture
    def slicer(self, tmp_path):
        """Two layers, a kidney and a vessel under a mass; the grid is a part of the CT, as Slicer crops
        it.
        """

        def write(*extra):
            empty = grid_around((-33, 18, -401), (-22, 30, -385), (0.7, 0.9, 1.6), DIRECTIONS["oblique"])
            grid = VoxelGrid.of(empty).part((slice(2, 14), slice(1, 12), slice(1, 9)))
            layers = np.zeros((*grid.size[::-1], 2), np.uint8)
            layers[1:6, 2:9, 2:9, 0], layers[:, :2, :2, 0], layers[3:8, 4:11, 4:11, 1] = 1, 2, 1
            fields = [*segment_lines(SEGMENTS), "Segmentation_ReferenceImageExtentOffset:=0 0 0", *extra]
            return write_nrrd(tmp_path / "a.seg.nrrd", grid, layers, fields=fields), grid, layers

        return write

    def test_slicer(self, slicer):
        path, grid, layers = slicer()
        maps = open_labels(path).maps(None)
        assert len(maps) == 2 and all(one.grid.same_as(grid) for one in maps)
        labelled = by_name(maps)
        assert np.array_equal(labelled["Kidney L"], layers[..., 0] == 1)
        assert np.array_equal(labelled["aorta"], layers[..., 0] == 2)
        assert np.array_equal(labelled["renal mass"], layers[..., 1] == 1)
        more = slicer("Segment3_Name:=GTV", "Segment3_LabelValue:=7")[0]
        assert [s.name for s in open_labels(more).empty] == ["GTV"]
        segments = {s.name: s for one in maps for s in one.segments.values()}
        assert segments["Kidney L"] == Segment("Kidney L", 1, "kidney", "left", (0.5, 0.25, 1.0))
        assert segments["renal mass"].tissue == "tumour" and segments["aorta"].value == 2

    @pytest.mark.parametrize("extra", ["Segment3_Layer:=two", "Segment3_LabelValue:=1.5"])
    def test_slicer_damaged(self, slicer, extra):
        refusal(slicer("Segment3_Name:=x", extra)[0], read=open_labels)

    def test_slicer_garbled_key(self, slicer):
        """Bytes that are no UTF-8 say nothing about labels."""
        path, _, layers = slicer("k\xe4y:=\xe4")
        assert np.array_equal(by_name(open_labels(path).maps(None))["renal mass"], layers[..., 1] == 1)

    def test_an_organ_a_file(self, tmp_path):
        empty = grid_around((-33, 18, -401), (-22, 30, -385), (0.7, 0.9, 1.6), DIRECTIONS["RAS"])
        for name, shape in {"kidney_left": KIDNEY, "liver": TUMOUR}.items():
            sitk.WriteImage(drawn(empty, (1, shape)), str(tmp_path / f"{name}.nii.gz"))
        sitk.WriteImage(empty, str(tmp_path / "kidney_cyst_left.nii.gz"))
        sitk.WriteImage(empty, str(tmp_path / "kidney_right.nii.gz"))
        (tmp_path / "brain.nii.gz").write_bytes(b"never read")
        labelled = by_name(open_labels(tmp_path).maps(None), VoxelGrid.of(empty))
        assert set(labelled) == {"kidney_left", "liver"}
        assert {s.name for s in open_labels(tmp_path).empty} == {"kidney_right", "kidney_cyst_left"}
        assert np.array_equal(labelled["kidney_left"], sitk.GetArrayFromImage(drawn(empty, (1, KIDNEY))) == 1)
        refusal(tmp_path, read=lambda path: open_labels(path, wanted=["Brain"]), name="brain.nii.gz")

    def test_nothing_marked(self, tmp_path):
        sitk.WriteImage(sitk.Image([8, 8, 8], sitk.sitkUInt8), str(tmp_path / "kidney_left.nii.gz"))
        assert "kidney_left.nii.gz: is empty" in refusal(tmp_path, read=open_labels)
        sitk.WriteImage(sitk.Image([8, 8, 8], sitk.sitkUInt8), str(tmp_path / "kidney_right.nii.gz"))
        assert "2 label files are empty" in refusal(tmp_path, read=open_labels)
        (tmp_path / "texts").mkdir()
        (tmp_path / "texts" / "a.md").write_text("a")
        assert "has no labels; expected a label map" in refusal(tmp_path / "texts", read=open_labels)
        assert "no such file" in refusal(tmp_path / "absent", read=open_labels)
        assert "has no labels" in refusal(Series(tmp_path / "ct").write(), read=open_labels)

    def test_a_folder_with_one_map_is_the_map(self, tmp_path):
        """Read as one organ per file, its labels would lose their values."""
        empty = grid_around((-33, 18, -401), (-22, 30, -385), (0.7, 0.9, 1.6), DIRECTIONS["RAS"])
        sitk.WriteImage(drawn(empty, (1, KIDNEY), (2, TUMOUR)), str(tmp_path / "kidneys.nii.gz"))
        of_folder, of_file = (
            [(s.value, str(s)) for one in open_labels(path).maps(None) for s in one.segments.values()]
            for path in (tmp_path, tmp_path / "kidneys.nii.gz")
        )
        assert of_folder == of_file and [value for value, _ in of_folder] == [1, 2]


class TestSegmentations:
    @pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
    def test_masks(self, series, tmp_path, kind):
        kidney, tumour = solid(series, KIDNEY), solid(series, TUMOUR)
        assert (kidney & tumour).any() and (tumour & ~kidney).any()
        if kind == "LABELMAP":
            kidney = kidney & ~tumour
        masks = {"Kidney left": kidney, "renal mass": tumour}
        drawing = open_labels(write_segmentation(tmp_path / "seg.dcm", series, masks, kind))
        maps = drawing.maps(None)
        labelled = by_name(maps, ct_grid(series))
        assert all(np.array_equal(labelled[name], mask) for name, mask in masks.items())
        segments = [s for one in maps for s in one.segments.values()]
        assert [(s.value, s.tissue, s.side) for s in segments] == [(1, "kidney", "left"), (2, "tumour", None)]
        assert drawing.references.series == {series.uid}
        assert any("50%" in note for note in drawing.notes) == (kind == "FRACTIONAL")

    def test_shares(self, tmp_path):
        series = Series(tmp_path / "ct")
        shares = np.zeros(series.size[::-1])
        shares[1:4, 2:6, 2:6], shares[2, 3, 3], shares[3, 2, 2] = 0.4, 0.7, 0.5
        path = write_segmentation(tmp_path / "seg.dcm", series, {"Kidney": shares}, "FRACTIONAL")
        assert np.array_equal(by_name(open_labels(path).maps(None), ct_grid(series))["Kidney"], shares >= 0.5)

    def test_half_is_in(self, tmp_path):
        """127 of 254."""
        series, shares = Series(tmp_path / "ct"), np.zeros((6, 10, 12))
        shares[1:4, 2:6, 2:6], shares[2, 3, 3] = 0.4, 0.5
        data = pydicom.dcmread(
            path := write_segmentation(tmp_path / "seg.dcm", series, {"Kidney": shares}, "FRACTIONAL")
        )
        data.PixelData, data.MaximumFractionalValue = data.PixelData.replace(b"\x80", b"\x7f"), 254
        data.save_as(path)
        labelled = by_name(open_labels(path).maps(None), ct_grid(series))["Kidney"]
        assert np.array_equal(labelled, shares == 0.5)

    def test_beside_its_series(self, series, tmp_path):
        write_segmentation(tmp_path / "ct" / "seg.dcm", series, {"Kidney": solid(series, KIDNEY)})
        assert "Kidney" in by_name(open_labels(tmp_path / "ct").maps(None))
        assert np.array_equal(open_ct(tmp_path / "ct").read().sum(), series.hounsfield.sum())
        archive = zipped(tmp_path / "ct", tmp_path / "a.zip")
        labelled = by_name(open_labels(archive).maps(None), ct_grid(series))
        assert np.array_equal(labelled["Kidney"], solid(series, KIDNEY))
        shutil.copy(tmp_path / "ct" / "seg.dcm", tmp_path / "ct" / "seg2.dcm")
        assert "2 segmentations" in refusal(tmp_path / "ct", read=open_labels, name="seg2.dcm")

    @pytest.mark.parametrize(
        ("labels", "plain", "values"),
        [
            ("liver.dcm", "liver_seg.nrrd", {1: 1}),
            ("24x38x3/seg", "24x38x3/nrrd/label.nrrd", {1: 1}),
            ("23x38x3/seg", "23x38x3/nrrd/label.nrrd", {1: 1}),
            ("partial_overlaps.dcm", "partial_overlaps-1.nrrd", {1: 1, 4: 4, 5: 5}),
            ("partial_overlaps.dcm", "partial_overlaps-2.nrrd", {2: 2}),
            ("partial_overlaps.dcm", "partial_overlaps-3.nrrd", {3: 3}),
            ("sparse-labelmap-noppv.dcm", "sparse_labelmap_noppv_seg.nrrd", {1: 1}),
            ("sparse-labelmap-ppv5.dcm", "sparse_labelmap_ppv5_seg.nrrd", {1: 1}),
        ],
    )  # fmt: skip
    def test_real_ones_are_their_label_maps(self, data, labels, plain, values):
        folder = data / "dicom/dcmqi/data/segmentations"
        (other,) = open_labels(folder / plain).maps(None)
        numbered = {
            s.value: one for one in open_labels(folder / labels).maps(None) for s in one.segments.values()
        }
        for number, value in values.items():
            assert np.array_equal(on(other.grid, numbered[number], 1), other.values == value)


def ring(centre, radius, direction, points=360):
    """A circle in the plane of a CT's slices."""
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)[:, None]
    return centre + radius * (np.cos(turn) * direction[:, 0] + np.sin(turn) * direction[:, 1])


class TestContours:
    OUTER, INNER = 5.2, 2.3

    @pytest.mark.parametrize("step", [1, 2])
    def test_rings(self, series, tmp_path, step):
        """A pixel is in where its middle is, to what the contour's corners and four decimals cut off."""
        grid = ct_grid(series)
        planes = range(1, 8, step)
        middles = [grid.place([[10.3, 9.6, k]])[0] for k in planes]
        rings = [ring(m, r, series.direction) for m in middles for r in (self.OUTER, self.INNER)]
        path = write_structures(tmp_path / "rt.dcm", {"Kidney R": rings, "GTV": rings[:2]}, series.uid)
        drawing = open_labels(path)
        assert drawing.references.series == {series.uid}
        kidney, mass = drawing.maps(open_ct(tmp_path / "ct").grid)
        assert kidney.segments == {1: Segment("Kidney R", 1, "kidney", "right", (1.0, 0.0, 0.2))}
        assert mass.segments[1].tissue == "tumour" and mass.values.any(axis=(1, 2)).sum() == 1
        assert kidney.grid.spacing[2] == pytest.approx(step * series.gap, abs=1e-3)
        cut = self.OUTER * (1 - np.cos(np.pi / 360)) + 2e-4
        labelled = on(grid, kidney, 1)
        radius = np.full(grid.size[::-1], np.inf)
        for k, middle in zip(planes, middles, strict=True):
            radius[k] = np.linalg.norm(series.places(k) - middle, axis=-1)
        assert labelled[(radius > self.INNER + cut) & (radius < self.OUTER - cut)].all()
        assert not labelled[(radius < self.INNER - cut) | (radius > self.OUTER + cut)].any()

    def test_across_slices(self, series, tmp_path):
        turned = Rotation.from_rotvec(0.9 * series.direction[:, 0]).as_matrix() @ series.direction
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": [ring(KIDNEY[0], 5, turned)]})
        grid = open_ct(tmp_path / "ct").grid
        message = refusal(path, read=lambda path: open_labels(path).maps(grid))
        assert "cross the slices" in message and "CT that they were drawn on" in message

    @pytest.mark.parametrize("kind", ["POINT", "OPEN_PLANAR", None])
    def test_no_closed_contour(self, series, tmp_path, kind):
        path = write_structures(
            tmp_path / "rt.dcm", {"Kidney": [ring(KIDNEY[0], 5, series.direction)]}, kind=kind
        )
        assert "no closed contour" in refusal(path, read=lambda path: open_labels(path).maps(ct_grid(series)))

    @pytest.mark.parametrize("far", [1e6, 1e30, np.nan])
    def test_far_points(self, tmp_path, far):
        series = Series(tmp_path / "ct")
        points = ring(KIDNEY[0], 5, series.direction)
        points[3] += far * series.direction[:, 0]
        path = write_structures(tmp_path / "rt.dcm", {"Kidney": [points]})
        refusal(path, read=lambda path: open_labels(path).maps(ct_grid(series)))


class TestTogether:
    def maps(self):
        coarse = grid_around((-33, 18, -401), (-22, 30, -385), (0.7, 0.9, 1.6), DIRECTIONS["oblique"])
        fine = grid_around((-30, 21, -396), (-24, 28, -386), (0.5, 0.5, 0.5), DIRECTIONS["left-handed"])
        names = {1: "kidney_left"}, {1: "mass"}
        return [
            LabelMap.of(drawn(fine, (1, TUMOUR)), names[1]),
            LabelMap.of(drawn(coarse, (1, KIDNEY)), names[0]),
        ]

    def test_tumour_wins(self):
        """Nearest neighbour moves a border by half a voxel's diagonal at most."""
        mass, kidney = self.maps()
        one, _ = merge_label_maps([mass, kidney])
        np.testing.assert_allclose(one.grid.spacing, kidney.grid.spacing)
        index = np.argwhere(np.ones(one.values.shape, bool))[:, ::-1]
        places, values = one.grid.place(index), one.values.ravel()
        (of_kidney,), (of_mass,) = one.of_tissues("kidney"), one.of_tissues("tumour")
        grow = 0.5 * np.linalg.norm(kidney.grid.spacing)
        larger, smaller = [(TUMOUR[0], TUMOUR[1] + sign * grow) for sign in (1, -1)]
        assert (values[level(places, smaller) < 0] == of_mass).all() and (level(places, smaller) < 0).any()
        clear = level(places, larger) > 0
        assert np.array_equal(values[clear] == of_kidney, level(places, KIDNEY)[clear] < 0)
        assert (level(one.grid.corners(), KIDNEY) > 0).all()

    def test_words(self):
        maps = self.maps()
        mass, kidney = assign_tissues(maps, ["kidney_left"], {"cyst": ["MASS"]})
        assert [s.tissue for one in (mass, kidney) for s in one.segments.values()] == ["cyst", "kidney"]
        with pytest.raises(
            PatientError, match="label 4 is not in the label map: it has 1 “mass”, 1 “kidney_left”"
        ):
            assign_tissues(maps, ["4"], {})
        with pytest.raises(PatientError, match="given as cyst and as tumour: give it as one"):
            assign_tissues(maps, ["mass"], {"cyst": ["mass"], "tumour": ["mass"]})
        # A number is a typing error where segments have names alone, and a name unless its segment is empty.
        unnumbered = [
            replace(one, segments={1: Segment.named(s.name)}) for one in maps for s in one.segments.values()
        ]
        for label_maps, word in ((maps, "cyst"), (unnumbered, "2")):
            with pytest.raises(PatientError, match=f"the cyst's label {word} is not in the label map"):
                assign_tissues(label_maps, [], {"cyst": [word]})
        assert assign_tissues(maps, [], {"cyst": ["cyst"]}, [Segment.named("Cyst")]) == maps
        with pytest.raises(PatientError, match="the organ's label kidney_right is not in the label map"):
            assign_tissues(maps, ["kidney_right"], {}, [Segment.named("kidney_right")])
        plain = LabelMap.of(drawn(grid_around((-33, 18, -401), (-22, 30, -385), (1, 1, 1)), (5, KIDNEY)))
        (assigned,) = assign_tissues([plain], ["5"], {})
        assert assigned.segments[5].tissue == "kidney"


def test_names_in_a_nifti_header(tmp_path):
    """TotalSegmentator's one file of all organs carries their names in an extension."""
    table = "".join(
        f'<Label Key="{n}" Red="1"><![CDATA[{name}]]></Label>'
        for n, name in ((3, "kidney_left"), (5, "liver"))
    )
    values = np.zeros((6, 6, 6), np.uint8)
    values[1:3], values[4:] = 3, 5
    image = nibabel.Nifti1Image(values, np.eye(4))
    image.set_sform(np.eye(4), code=1)
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, f"<CaretExtension>{table}".encode()))
    nibabel.save(image, tmp_path / "all.nii.gz")
    (one,) = open_labels(tmp_path / "all.nii.gz").maps(None)
    assert {v: (s.name, s.tissue, s.side) for v, s in one.segments.items()} == {
        3: ("kidney_left", "kidney", "left"),
        5: ("liver", "liver", None),
    }
