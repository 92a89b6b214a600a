"""Reading volumes: DICOM series as they come, NIfTI, NRRD and MHA."""

from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from synthetic_body import (
    DIRECTIONS,
    grid_around,
    with_voxels,
)

from scenes.patient import PatientError, read_volume

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


class Series:
    """A tiny CT series on disk: 6 slices of 12 x 10 voxels, 0.8 x 0.7 mm, 2.5 mm apart, any orientation."""

    size, spacing, gap = (12, 10, 6), (0.8, 0.7), 2.5

    def __init__(self, folder, direction=DIRECTIONS["oblique"], origin=(-31.5, 20.25, -400.0), number=1):
        self.folder, self.direction, self.origin = folder, direction, np.array(origin)
        self.uid, self.number = generate_uid(), number
        nx, ny, nz = self.size
        self.hounsfield = np.random.default_rng(7).integers(-1000, 1500, (nz, ny, nx))

    def position(self, k):
        return self.origin + k * self.gap * self.direction[:, 2]

    def write(self, order=range(6), position=None, **tags):
        self.folder.mkdir(parents=True, exist_ok=True)
        for n, k in enumerate(order):
            meta = FileMetaDataset()
            meta.MediaStorageSOPClassUID, meta.TransferSyntaxUID = CTImageStorage, ExplicitVRLittleEndian
            meta.MediaStorageSOPInstanceUID = generate_uid()
            file = self.folder / f"s{self.number}-{n}.dcm"
            data = FileDataset(str(file), {}, file_meta=meta, preamble=b"\0" * 128)
            data.SOPClassUID, data.SOPInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID
            data.Modality, data.SeriesInstanceUID, data.SeriesNumber = "CT", self.uid, self.number
            data.PatientName, data.PatientID, data.StudyInstanceUID = "Doe^Jane", "4711", self.uid
            data.ImagePositionPatient = np.round((position or self.position)(k), 6).tolist()
            data.ImageOrientationPatient = np.round(self.direction[:, :2].T.ravel(), 8).tolist()
            data.PixelSpacing = [self.spacing[1], self.spacing[0]]
            data.SliceThickness, data.InstanceNumber = self.gap, 6 - n
            data.Columns, data.Rows, _ = self.size
            data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
            data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 12, 11, 0
            data.RescaleIntercept, data.RescaleSlope = -1024, 1
            data.PixelData = (self.hounsfield[k] + 1024).astype("<u2").tobytes()
            for name, value in tags.items():
                setattr(data, name, value)
            pydicom.dcmwrite(file, data, enforce_file_format=True)
        return self.folder


class TestReading:
    def test_dicom_series(self, tmp_path):
        series = Series(tmp_path / "ct")
        series.write(order=(3, 0, 5, 1, 4, 2))
        (tmp_path / "ct" / "notes.txt").write_text("no slice")
        image = read_volume(tmp_path / "ct")

        assert np.array_equal(sitk.GetArrayViewFromImage(image), series.hounsfield)
        np.testing.assert_allclose(image.GetSpacing(), (0.8, 0.7, 2.5), atol=1e-5)
        np.testing.assert_allclose(image.GetOrigin(), series.origin, atol=1e-5)
        np.testing.assert_allclose(np.reshape(image.GetDirection(), (3, 3)), series.direction, atol=1e-6)
        assert not image.GetMetaDataKeys()

    def test_two_series_are_named(self, tmp_path):
        Series(tmp_path, number=3).write()
        Series(tmp_path, number=8).write(order=range(4))
        with pytest.raises(PatientError, match=r"2 series.*series 3 \(CT, 6 files.*series 8 \(CT, 4 files"):
            read_volume(tmp_path)

    @pytest.mark.parametrize(
        ("writing", "words"),
        [
            ({"Modality": "MR"}, "the modality is MR; expected CT"),
            ({"order": (0, 1, 2, 4, 5)}, r"s1-2.dcm and s1-3.dcm are 5\.00 mm apart, the others 2\.50 mm"),
            ({"order": (0, 1, 2, 2, 3)}, "lie at one position"),
            ({"order": (2,)}, "one slice only"),
            ({"NumberOfFrames": 2}, "holds 2 frames"),
        ],
    )
    def test_bad_series(self, tmp_path, writing, words):
        with pytest.raises(PatientError, match=words) as caught:
            read_volume(Series(tmp_path).write(**writing))
        assert "Doe" not in str(caught.value) and "4711" not in str(caught.value)

    def test_uneven_and_tilted_series(self, tmp_path):
        uneven = Series(tmp_path / "uneven", DIRECTIONS["identity"])
        with pytest.raises(PatientError, match="off an even spacing"):
            read_volume(uneven.write(position=lambda k: uneven.position(k + 0.02 * k**2)))
        tilted = Series(tmp_path / "tilted", DIRECTIONS["identity"])
        with pytest.raises(PatientError, match="gantry tilt"):
            read_volume(tilted.write(position=lambda k: tilted.position(k) + (0, 0.3 * k, 0)))

    def test_mixed_slices(self, tmp_path):
        series = Series(tmp_path)
        series.write(order=range(3))
        other = pydicom.dcmread(tmp_path / "s1-2.dcm")
        other.ImageOrientationPatient = [1, 0, 0, 0, 0, -1]
        other.save_as(tmp_path / "s1-2.dcm")
        with pytest.raises(PatientError, match="orientation"):
            read_volume(tmp_path)

    def test_folder_without_dicom(self, tmp_path):
        with pytest.raises(PatientError, match="no DICOM file"):
            read_volume(tmp_path)
        with pytest.raises(PatientError, match="no such file"):
            read_volume(tmp_path / "absent.nrrd")

    @pytest.mark.parametrize("ending", [".nii", ".nii.gz", ".nrrd", ".mha", ".mhd"])
    def test_files_keep_their_place(self, tmp_path, ending):
        image = grid_around((0, 0, 0), (20, 15, 10), (1.0, 1.5, 2.0), DIRECTIONS["oblique"])
        image = with_voxels(
            image, np.random.default_rng(3).integers(-900, 900, image.GetSize()[::-1], np.int16)
        )
        image.SetMetaData("descrip", "Doe^Jane")
        sitk.WriteImage(image, str(tmp_path / f"ct{ending}"))
        again = read_volume(tmp_path / f"ct{ending}")
        assert np.array_equal(sitk.GetArrayViewFromImage(again), sitk.GetArrayViewFromImage(image))
        np.testing.assert_allclose(again.GetOrigin(), image.GetOrigin(), atol=1e-4)
        np.testing.assert_allclose(again.GetDirection(), image.GetDirection(), atol=1e-5)
        assert not again.GetMetaDataKeys()

    def test_bad_files(self, tmp_path):
        (tmp_path / "cut.nrrd").write_bytes(b"NRRD0004\nnonsense")
        (tmp_path / "ct.txt").write_text("text")
        sitk.WriteImage(sitk.Image([8, 8], sitk.sitkInt16), str(tmp_path / "flat.mha"))
        sitk.WriteImage(sitk.Image([8, 8, 8], sitk.sitkVectorUInt8, 3), str(tmp_path / "rgb.mha"))
        holed = with_voxels(sitk.Image([4, 4, 4], sitk.sitkFloat32), np.full((4, 4, 4), np.nan, np.float32))
        sitk.WriteImage(holed, str(tmp_path / "nan.mha"))
        for name, words in [
            ("cut.nrrd", "cannot be read"),
            ("ct.txt", "unknown kind of file"),
            ("flat.mha", "expected one 3D volume"),
            ("rgb.mha", "expected one number"),
            ("nan.mha", "64 voxels are not finite"),
        ]:
            with pytest.raises(PatientError, match=words) as caught:
                read_volume(tmp_path / name)
            assert "\n" not in str(caught.value) and name in str(caught.value)
