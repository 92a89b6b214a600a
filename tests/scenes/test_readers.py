"""Volumes in files, and real DICOM: each voxel keeps its value and its place in the patient."""

import os
import random
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_series import (
    Series,
    read_ct,
    refusal,
    write_dicomdir,
    write_segmentation,
    write_structures,
    zipped,
)
from pydicom.uid import DeflatedExplicitVRLittleEndian, generate_uid
from raw_nrrd import with_segments
from synthetic_body import DIRECTIONS, grid_around, with_voxels

from errors import PatientError
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels
from scenes.volumes.lazy_volume import LazyVolume

AIR = -1000
FAILING = "dicom/dicom2nifti/tests/data/failing"
SYNTAXES = "dicom/cornerstone_ct_all_syntaxes"
ENDINGS = [".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd"]
RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def noise(direction=DIRECTIONS["oblique"], kind=np.int16):
    """An image of 20 x 15 x 10 mm, all voxels different in their noise."""
    image = grid_around((0, 0, 0), (20, 15, 10), (1.0, 1.5, 2.0), direction)
    image.SetOrigin((np.array(image.GetOrigin()) + (-31.5, 20.25, -400)).tolist())
    voxels = np.random.default_rng(3).integers(0, 900, image.GetSize()[::-1])
    return with_voxels(image, voxels.astype(kind))


def affine_of(image):
    """Voxel index to RAS [mm], as NIfTI has it."""
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return RAS @ affine


def nifti(path, image, forms=(("s", 1), ("q", 1)), unit="mm", voxels=None, affines=None, **header):
    """A NIfTI file with forms and codes of one's own."""
    affine = affine_of(image)
    voxels = sitk.GetArrayFromImage(image).T if voxels is None else voxels
    made = nibabel.Nifti1Image(voxels, affine)
    made.set_sform(affine, 0)
    made.set_qform(affine, 0)
    scale = {"meter": 1e-3, "micron": 1e3}.get(unit, 1.0)
    for n, (form, code) in enumerate(forms):
        placed = np.diag([scale, scale, scale, 1]) @ (affine if affines is None else affines[n])
        (made.set_sform if form == "s" else made.set_qform)(placed, code)
    made.header.set_xyzt_units(unit)
    for key, value in header.items():
        made.header[key] = value
    nibabel.save(made, path)
    return path


def assert_same(volume, image, atol=1e-3):
    """Voxels, and their places to what NIfTI's single precision leaves."""
    again = volume.image()
    assert np.array_equal(sitk.GetArrayFromImage(again), sitk.GetArrayFromImage(image))
    for corner in ((0, 0, 0), (1, 2, 3), tuple(n - 1 for n in image.GetSize())):
        np.testing.assert_allclose(
            again.TransformIndexToPhysicalPoint(corner),
            image.TransformIndexToPhysicalPoint(corner),
            atol=atol,
        )


class TestFiles:
    @pytest.mark.parametrize("ending", ENDINGS)
    @pytest.mark.parametrize("direction", DIRECTIONS)
    def test_keep_their_place(self, tmp_path, ending, direction):
        image = noise(DIRECTIONS[direction])
        marked = sitk.Image(image)
        marked.SetMetaData("descrip", "Doe^Jane")
        # NRRD and MetaImage are packed by request, NIfTI by its name.
        sitk.WriteImage(marked, str(tmp_path / f"ct{ending}"), useCompression=direction in ("RAS", "oblique"))
        assert_same(open_ct(tmp_path / f"ct{ending}"), image)
        assert not open_ct(tmp_path / f"ct{ending}").image().GetMetaDataKeys()

    def test_other_words_of_metaimage(self, tmp_path):
        path = written(tmp_path / "ct.mha")
        content = path.read_bytes().replace(b"TransformMatrix", b"Rotation", 1)
        assert b"Rotation" in content and b"Offset" in content
        path.write_bytes(content.replace(b"Offset", b"Position", 1))
        assert_same(open_ct(path), noise())

    @pytest.mark.parametrize("ending", [".nhdr", ".mhd"])
    def test_voxels_beside_a_small_header(self, tmp_path, ending):
        large = sitk.Image([160, 120, 90], sitk.sitkInt16)
        sitk.WriteImage(large, str(tmp_path / f"ct{ending}"))
        assert open_ct(tmp_path / f"ct{ending}").hounsfield().shape == (90, 120, 160)

    @pytest.mark.parametrize("ending", ENDINGS)
    def test_part(self, tmp_path, ending):
        sitk.WriteImage(noise(), str(tmp_path / f"ct{ending}"))
        box = slice(3, 11), slice(2, 7), slice(1, 4)
        part = open_ct(tmp_path / f"ct{ending}").image(box)
        assert np.array_equal(sitk.GetArrayFromImage(part), sitk.GetArrayFromImage(noise())[1:4, 2:7, 3:11])
        np.testing.assert_allclose(
            part.GetOrigin(), noise().TransformIndexToPhysicalPoint((3, 2, 1)), atol=1e-3
        )

    @pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.float32, np.float64])
    @pytest.mark.parametrize("ending", [".nii.gz", ".nrrd", ".mha"])
    def test_kinds_of_number(self, tmp_path, ending, kind):
        if kind is np.uint8:
            image = with_voxels(noise(), sitk.GetArrayFromImage(noise()).astype(kind))
        else:
            image = noise(kind=kind)
        sitk.WriteImage(image, str(tmp_path / f"ct{ending}"))
        voxels = open_ct(tmp_path / f"ct{ending}").hounsfield()
        assert voxels.dtype == np.int16 and np.array_equal(voxels, sitk.GetArrayFromImage(image))

    def test_fractions_are_rounded(self, tmp_path):
        image = with_voxels(noise(), sitk.GetArrayFromImage(noise()) + np.float32(0.4))
        sitk.WriteImage(image, str(tmp_path / "ct.nii.gz"))
        assert np.array_equal(open_ct(tmp_path / "ct.nii.gz").hounsfield(), sitk.GetArrayFromImage(noise()))

    def test_padding_is_air(self, tmp_path):
        voxels = sitk.GetArrayFromImage(noise())
        voxels[:, :2], voxels[:, 2] = -3024, -1024
        sitk.WriteImage(with_voxels(noise(), voxels), str(tmp_path / "ct.mha"))
        again = open_ct(tmp_path / "ct.mha").hounsfield()
        assert (again[:, :2] == AIR).all() and np.array_equal(again[:, 2:], voxels[:, 2:])

    def test_image_in_memory(self):
        """A volume keeps its voxels when nobody keeps the image."""
        volume = LazyVolume.of(noise())
        others = [sitk.Image(noise().GetSize(), sitk.sitkInt16) + n for n in range(20)]
        assert np.array_equal(volume.hounsfield(), sitk.GetArrayFromImage(noise())), len(others)


class TestNifti:
    @pytest.mark.parametrize("unit", ["mm", "meter", "micron", "unknown"])
    @pytest.mark.parametrize("forms", [[("s", 1)], [("q", 1)], [("s", 2), ("q", 1)], [("s", 4)]])
    def test_units_and_forms(self, tmp_path, unit, forms):
        """A metre's single precision is 1e-7 of a place 0.4 m away."""
        assert_same(open_ct(nifti(tmp_path / "ct.nii", noise(), forms, unit)), noise())

    def test_scaled(self, tmp_path):
        voxels = sitk.GetArrayFromImage(noise()).T
        path = nifti(tmp_path / "ct.nii.gz", noise(), voxels=voxels)
        content = nibabel.load(path)
        content.header.set_slope_inter(2, -1000)
        scaled = nibabel.Nifti1Image(
            content.dataobj.get_unscaled() * 2.0 - 1000, content.affine, content.header
        )
        scaled.header.set_data_dtype(np.int16)
        nibabel.save(scaled, tmp_path / "scaled.nii.gz")
        assert np.array_equal(open_ct(tmp_path / "scaled.nii.gz").hounsfield(), voxels.T * 2.0 - 1000)

    def test_one_of_four_dimensions(self, tmp_path):
        path = nifti(tmp_path / "ct.nii", noise(), voxels=sitk.GetArrayFromImage(noise()).T[..., None])
        assert_same(open_ct(path), noise())

    def test_conflict_of_forms(self, tmp_path):
        shifted = affine_of(noise())
        shifted[0, 3] += 30
        both = [affine_of(noise()), shifted]
        path = nifti(tmp_path / "ct.nii", noise(), [("s", 2), ("q", 1)], affines=both)
        volume = open_ct(path)
        np.testing.assert_allclose(volume.grid.origin, (RAS @ shifted)[:3, 3], atol=1e-3)
        path = nifti(tmp_path / "ct.nii", noise(), [("s", 1), ("q", 1)], affines=both)
        assert "sform and qform differ by up to 30.0 mm" in refusal(path)

    @pytest.mark.parametrize("direction", ["identity", "oblique"])
    @pytest.mark.parametrize("apart_mm, is_one", [(0.45, True), (0.55, False)])
    def test_forms_that_differ_by_less_than_half_a_voxel_are_one(self, tmp_path, direction, apart_mm, is_one):
        """Voxels of 1.0 x 1.5 x 2.0 mm, moved by so much of the shortest: quaternions round."""
        image = noise(DIRECTIONS[direction])
        moved = affine_of(image)
        moved[2, 3] += apart_mm
        path = nifti(tmp_path / "ct.nii", image, affines=[affine_of(image), moved])
        if is_one:
            assert_same(open_ct(path), image)
        else:
            assert "sform and qform differ" in refusal(path)

    def test_no_orientation(self, tmp_path):
        assert "has no orientation" in refusal(nifti(tmp_path / "ct.nii", noise(), []))


def doubled(file, folder):
    """A folder with a slice and its copy 3 mm further on, pixels and transfer syntax as they are."""
    folder.mkdir()
    shutil.copy(file, folder / "a.dcm")
    data = pydicom.dcmread(file)
    row, column = np.reshape(data.ImageOrientationPatient, (2, 3))
    further = np.array(data.ImagePositionPatient) + 3 * np.cross(row, column)
    data.ImagePositionPatient = np.round(further, 5).tolist()
    data.InstanceNumber, data.SOPInstanceUID = int(data.InstanceNumber) + 1, generate_uid()
    data.save_as(folder / "b.dcm")
    return folder


class TestRealData:
    @pytest.mark.parametrize(
        ("ending", "bound"),
        [
            ("LittleEndianImplicitTransferSyntax_1.2.840.10008.1.2", 0),
            ("LittleEndianExplicitTransferSyntax_1.2.840.10008.1.2.1", 0),
            ("BigEndianExplicitTransferSyntax_1.2.840.10008.1.2.2", 0),
            ("DeflatedExplicitVRLittleEndianTransferSyntax_1.2.840.10008.1.2.1.99", 0),
            ("RLELosslessTransferSyntax_1.2.840.10008.1.2.5", 0),
            ("JPEGProcess14TransferSyntax_1.2.840.10008.1.2.4.57", 0),
            ("JPEGProcess14SV1TransferSyntax_1.2.840.10008.1.2.4.70", 0),
            ("JPEGLSLosslessTransferSyntax_1.2.840.10008.1.2.4.80", 0),
            ("JPEG2000LosslessOnlyTransferSyntax_1.2.840.10008.1.2.4.90", 0),
            ("JPEGLSLossyTransferSyntax_1.2.840.10008.1.2.4.81", 1),
            ("JPEG2000TransferSyntax_1.2.840.10008.1.2.4.91", 32),
            ("JPEGProcess2_4TransferSyntax_1.2.840.10008.1.2.4.51", 64),
            ("JPEGProcess1TransferSyntax_1.2.840.10008.1.2.4.50", 64),
            ("JPEGProcess6_8TransferSyntax_1.2.840.10008.1.2.4.53", 64),
            ("JPEGProcess10_12TransferSyntax_1.2.840.10008.1.2.4.55", 64),
        ],
    )
    def test_transfer_syntaxes(self, data, tmp_path, ending, bound):
        plain = read_ct(doubled(data / SYNTAXES / "CTImage.dcm", tmp_path / "plain"))[1]
        packed = doubled(data / SYNTAXES / f"CTImage.dcm_{ending}.dcm", tmp_path / "packed")
        voxels = read_ct(packed)[1]
        assert voxels.shape == (2, 512, 512)
        assert np.abs(voxels - plain).max() <= bound

    def test_perfusion_map(self, data):
        file = data / SYNTAXES / "CT0012.fragmented_no_bot_jpeg_baseline.51.dcm"
        message = refusal(file)
        assert "PERFUSION" in message and message.count(file.name) == 0

    @pytest.mark.parametrize(
        ("folder", "words"),
        [
            (f"{FAILING}/sliceincrement/001", ("slice 9 (", "slice 10 (", "10.00 mm apart, the others 5.00")),
            (f"{FAILING}/sliceincrement/002", ("slice 3 (", "slice 5 (", "1.50 mm apart, the others 0.75")),
            (f"{FAILING}/sliceorientation/001", ("4 MR", "expected a CT")),
            (f"{FAILING}/slicecount/001", ("2 MR", "expected a CT")),
            (f"{FAILING}/notavolume/001", ("slice 23 (", "slice 24 (", "one position")),
            (
                "dicom/dicom-numpy_dupe_positions",
                ("slice 80 (CT29.dcm)", "slice 34 (CT24.dcm)", "115.00 mm apart"),
            ),
        ],
    )
    def test_refused(self, data, folder, words):
        message = refusal(data / folder)
        assert all(part in message for part in words)

    def test_tilted(self, data):
        volume, voxels = read_ct(data / FAILING / "gantrytilting/001")
        assert "tilted by 14.0 degrees" in volume.notes[0] and volume.grid.size == (512, 521, 4)
        plain = pydicom.dcmread(data / FAILING / "gantrytilting/001/IM-0001-0004.dcm")
        at = volume.grid.index(np.array([plain.ImagePositionPatient], float))[0]
        np.testing.assert_allclose(at, (0, 0, 3), atol=1e-6)
        hounsfield = plain.pixel_array * float(plain.RescaleSlope) + float(plain.RescaleIntercept)
        hounsfield[hounsfield < -1024] = AIR
        assert np.array_equal(voxels[3, :512], hounsfield) and (voxels[3, 512:] == AIR).all()

    @pytest.mark.parametrize("size", ["24x38x3", "23x38x3"])
    def test_enhanced_is_its_slices(self, data, size):
        folder = data / "dicom/dcmqi/data/segmentations" / size
        one, plain = read_ct(folder / "image")
        other, enhanced = read_ct(folder / "multiframe/mf.dcm")
        assert one.grid.same_as(other.grid) and np.array_equal(plain, enhanced)

    @pytest.mark.parametrize(
        "file", ["highdicom/data/test_files/ct_image.dcm", "dcmqi/data/segmentations/ct-3slice/01.dcm"]
    )
    def test_pixels(self, data, tmp_path, file):
        plain = pydicom.dcmread(data / "dicom" / file)
        volume, voxels = read_ct(doubled(data / "dicom" / file, tmp_path / "ct"))
        hounsfield = plain.pixel_array * float(plain.RescaleSlope) + float(plain.RescaleIntercept)
        hounsfield[hounsfield < -1024] = AIR
        assert np.array_equal(voxels[0], hounsfield) and np.array_equal(voxels[1], hounsfield)
        np.testing.assert_allclose(volume.grid.origin, plain.ImagePositionPatient, atol=1e-4)


def written(path, image=None):
    sitk.WriteImage(noise() if image is None else image, str(path))
    return path


ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
KINDS = "dicom", "files", "labels"
# Of each of 14 files; the bytes are the same in each run.
CASES = 40


def in_another_process(*arguments):
    """What this file prints when it is run: a reader that is killed does not end the tests."""
    command = [sys.executable, __file__, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT)
    assert done.returncode == 0, done.stdout[-300:] + done.stderr[-600:]
    return done.stdout.splitlines()


def test_count_of_dimensions(tmp_path):
    """ITK takes it for a length of its own."""
    sound = written(tmp_path / "a.mha").read_bytes()
    paths = [tmp_path / f"{count}.mha" for count in (-3, 0, 11, 1000000000)]
    for path in paths:
        path.write_bytes(sound.replace(b"NDims = 3", f"NDims = {path.stem}".encode()))
    lines = in_another_process("read", *paths)
    assert [line.split(".mha")[0] for line in lines] == [path.stem for path in paths]


def test_chance_damage(tmp_path):
    """Flipped, inserted and lost bytes: a volume or labels that read, or one line."""
    lines = in_another_process("damage", tmp_path)
    assert lines[-1] == "sound", lines


def samples(folder, kind):
    """Small valid files: what is damaged, what is opened then, and how."""
    series = Series(folder / "dicom")
    mask = np.zeros(series.size[::-1])
    mask[1:4, 2:6, 3:9] = 1
    if kind == "dicom":
        series.write()
        Series(folder / "deflated").write(syntax=DeflatedExplicitVRLittleEndian)
        yield folder / "dicom" / "s1-0.dcm", folder / "dicom", open_ct
        yield folder / "deflated" / "s1-2.dcm", folder / "deflated", open_ct
        series.folder = folder
        for path in (
            series.write_enhanced(),
            zipped(folder / "dicom", folder / "ct.zip"),
            write_dicomdir(folder / "cd", [series.slice(k) for k in range(3)]),
        ):
            yield path, path, open_ct
    elif kind == "files":
        for name in ("a.nii", "b.nii.gz", "c.nrrd", "d.mha"):
            yield written(folder / name), folder / name, open_ct
    else:
        for form in ("BINARY", "LABELMAP"):
            path = write_segmentation(folder / f"{form}.dcm", series, {"Kidney": mask}, form)
            yield path, path, open_labels
        ring = series.places(2)[2:6, 2:7].reshape(-1, 3)[[0, 4, 19, 15]]
        path = write_structures(folder / "rt.dcm", {"Kidney": [ring]}, series.uid)
        yield path, path, open_labels
        layers = sitk.Compose(noise(kind=np.uint8), noise(kind=np.uint8))
        segments = [dict(Name="Kidney", Layer=n, LabelValue=1) for n in range(2)]
        path = written(folder / "k.seg.nrrd", with_segments(layers, segments))
        yield path, path, open_labels


def damaged(content, chance):
    content = bytearray(content)
    if chance.random() < 0.15:
        return content[: chance.randrange(len(content))]
    for _ in range(chance.choice((1, 1, 2, 4, 16))):
        at = chance.randrange(min(len(content), 1600))
        what = chance.random()
        if what < 0.6:
            content[at] = chance.choice((chance.randrange(256), content[at] ^ 1, 0, 255, 10))
        elif what < 0.8:
            del content[at : at + chance.choice((1, 2, 4))]
        else:
            content[at:at] = bytes(chance.randrange(256) for _ in range(chance.choice((1, 2, 4))))
    return content


def damage(kind, folder):
    """What damaged files do that they should not."""
    folder.mkdir()
    grid, faults = None, set()
    for target, path, read in samples(folder, kind):
        good, chance = target.read_bytes(), random.Random(target.name)
        grid = grid or open_ct(Series(folder / "grid").write()).grid
        for _ in range(CASES):
            target.write_bytes(damaged(good, chance))
            try:
                read_back = read(path)
                read_back.hounsfield() if read is open_ct else read_back.maps(grid)
            except PatientError as error:
                if not str(error).isprintable():
                    faults.add(f"{target.name}: several lines")
            except Exception as error:
                faults.add(f"{target.name}: {type(error).__name__} {str(error)[:80]}")
        target.write_bytes(good)
    return faults


if __name__ == "__main__":
    if sys.argv[1] == "damage":
        resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30,) * 2)
        faults = set().union(*(damage(kind, Path(sys.argv[2]) / kind) for kind in KINDS))
        print("\n".join(sorted(faults)) or "sound")
    else:
        for path in map(Path, sys.argv[2:]):
            try:
                open_ct(path).hounsfield()
            except PatientError as error:
                print(str(error).removeprefix(f"{path.parent}{os.sep}"))
