"""Synthetic DICOM on disk: CT series, enhanced CT, segmentations and structure sets, in any orientation."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import highdicom as hd
import numpy as np
import pydicom
import pytest
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.fileset import FileSet
from pydicom.sr.codedict import codes
from pydicom.uid import (
    UID,
    CTImageStorage,
    EnhancedCTImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    RTStructureSetStorage,
    generate_uid,
)
from synthetic_body import DIRECTIONS

from errors import PatientError
from scenes.patients.readers.ct_series import open_ct
from scenes.volumes.lazy_volume import LazyVolume

PERSON = {
    "PatientName": "Doe^Jane",
    "PatientID": "4711",
    "PatientBirthDate": "19600229",
    "PatientSex": "F",
    "StudyDate": "20240131",
    "StudyTime": "101112",
    "StudyID": "S77",
    "AccessionNumber": "A1234567",
}


def read_ct(path: Path, **options: str) -> tuple[LazyVolume, np.ndarray]:
    """A CT, and its HU."""
    volume = open_ct(path, **options)
    return volume, volume.hounsfield()


def refusal(
    path: Path, read: Callable[[Path], object] = read_ct, name: str | None = None, **options: str
) -> str:
    """The error for a path or a file in it: one line that names the file, and no person."""
    with pytest.raises(PatientError) as caught:
        read(path, **options)
    words = str(caught.value)
    assert words.isprintable() and (name or path.name) in words
    message = words.replace(str(path), "")
    assert not any(part in message for part in ("Doe", "Jane", "4711", "19600229", "A1234567"))
    return message


class Series:
    """A tiny CT series: by default 6 slices of 12 x 10 voxels, 0.8 x 0.7 mm, 2.5 mm apart, any orientation.

    `field` gives HU of places (n, 3) in LPS [mm]; without one the voxels are noise.
    """

    def __init__(
        self,
        folder: Path,
        direction: np.ndarray = DIRECTIONS["oblique"],
        number: int = 1,
        size: tuple[int, int, int] = (12, 10, 6),
        gap: float = 2.5,
        field: Callable[[np.ndarray], np.ndarray] | None = None,
        positions: Callable[[float], np.ndarray] | None = None,
        slope: float = 1.0,
        intercept: float = -1024.0,
        signed: bool = False,
        origin: Iterable[float] = (-31.5, 20.25, -400.0),
        frame_of_reference: str | None = None,
        spacing: tuple[float, float] = (0.8, 0.7),
    ) -> None:
        self.folder, self.direction, self.number = folder, np.asarray(direction, float), number
        self.size, self.spacing, self.gap = size, spacing, gap
        self.origin = np.array(list(origin), float)
        self.slope, self.intercept, self.signed = slope, intercept, signed
        self.uid, self.study = generate_uid(), generate_uid()
        self.frame_of_reference = frame_of_reference or generate_uid()
        self.sops = [generate_uid() for _ in range(size[2])]
        self.positions = positions or (lambda k: self.origin + k * gap * self.direction[:, 2])
        noise = np.random.default_rng(7).integers(0, 2400, size[::-1])
        stored = noise if field is None else np.stack([self._stored(field, k) for k in range(size[2])])
        self.stored = stored
        self.hounsfield = np.rint(stored * slope + intercept).astype(int)

    def _stored(self, field: Callable[[np.ndarray], np.ndarray], k: int) -> np.ndarray:
        return np.rint((field(self.places(k)) - self.intercept) / self.slope).astype(int)

    def places(self, k: float) -> np.ndarray:
        """LPS of the pixels (rows, columns, 3) of a slice."""
        columns, rows, _ = self.size
        j, i = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        return (
            self.positions(k)
            + i[..., None] * self.spacing[0] * self.direction[:, 0]
            + j[..., None] * self.spacing[1] * self.direction[:, 1]
        )

    def slice(self, k: int, syntax: UID = ExplicitVRLittleEndian, **tags: object) -> FileDataset:
        """The data set of a slice; tags are set on top, and taken out where they are None."""
        data = self._image(CTImageStorage, self.sops[k], syntax)
        data.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
        data.ImagePositionPatient = np.round(self.positions(k), 6).tolist()
        data.ImageOrientationPatient = np.round(self.direction[:, :2].T.ravel(), 8).tolist()
        data.PixelSpacing = [self.spacing[1], self.spacing[0]]
        data.SliceThickness, data.InstanceNumber = self.gap, k + 1
        data.RescaleIntercept, data.RescaleSlope = self.intercept, self.slope
        data.PixelData = self._pixels(self.stored[k], syntax)
        for name, value in tags.items():
            if value is None:
                delattr(data, name)
            else:
                setattr(data, name, value)
        return data

    def _pixels(self, stored: np.ndarray, syntax: UID = ExplicitVRLittleEndian) -> bytes:
        order = ">" if syntax == ExplicitVRBigEndian else "<"
        return stored.astype(f"{order}{'i' if self.signed else 'u'}2").tobytes()

    def _image(self, sop_class: UID, sop: str, syntax: UID) -> FileDataset:
        data = _file(sop_class, sop, syntax)
        data.Modality, data.SeriesInstanceUID, data.SeriesNumber = "CT", self.uid, self.number
        data.StudyInstanceUID, data.FrameOfReferenceUID = self.study, self.frame_of_reference
        data.Columns, data.Rows, _ = self.size
        data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
        data.BitsAllocated = data.BitsStored = 16
        data.HighBit, data.PixelRepresentation = 15, int(self.signed)
        return data

    def write(
        self,
        order: Iterable[int] | None = None,
        syntax: UID = ExplicitVRLittleEndian,
        name: str = "s{number}-{n}.dcm",
        edit: Callable[[FileDataset, int], None] | None = None,
        preamble: bool = True,
        **tags: object,
    ) -> Path:
        """Write slices; the n-th file holds the n-th of `order`."""
        for n, k in enumerate(range(self.size[2]) if order is None else order):
            data = self.slice(k, syntax, **tags)
            if edit:
                edit(data, k)
            file = self.folder / name.format(number=self.number, n=n, k=k)
            save(data, file, preamble)
        return self.folder

    def write_enhanced(
        self, order: Iterable[int] | None = None, shared: bool = True, slopes: Iterable[float] = ()
    ) -> Path:
        """Write one enhanced multi-frame file; slopes make a rescale of each frame's own."""
        order, slopes = list(order or range(self.size[2])), list(slopes)
        data = self._image(EnhancedCTImageStorage, generate_uid(), ExplicitVRLittleEndian)
        data.ImageType, data.NumberOfFrames = ["ORIGINAL", "PRIMARY", "VOLUME", "NONE"], len(order)
        common, frames, pixels = Dataset(), [], []
        common.PixelMeasuresSequence = [Dataset()]
        common.PixelMeasuresSequence[0].PixelSpacing = [self.spacing[1], self.spacing[0]]
        common.PixelMeasuresSequence[0].SliceThickness = self.gap
        common.PlaneOrientationSequence = [Dataset()]
        common.PlaneOrientationSequence[0].ImageOrientationPatient = (
            np.round(self.direction[:, :2].T.ravel(), 8).tolist()
        )  # fmt: skip
        for n, k in enumerate(order):
            frame = Dataset()
            frame.PlanePositionSequence = [Dataset()]
            frame.PlanePositionSequence[0].ImagePositionPatient = np.round(self.positions(k), 6).tolist()
            scale = Dataset()
            scale.RescaleSlope = slopes[n] if slopes else self.slope
            scale.RescaleIntercept, scale.RescaleType = self.intercept, "HU"
            stored = np.rint((self.hounsfield[k] - self.intercept) / float(scale.RescaleSlope))
            (frame if slopes or not shared else common).PixelValueTransformationSequence = [scale]
            if not shared:
                frame.PixelMeasuresSequence = common.PixelMeasuresSequence
                frame.PlaneOrientationSequence = common.PlaneOrientationSequence
            frames.append(frame)
            pixels.append(self._pixels(stored))
        data.SharedFunctionalGroupsSequence = [common if shared else Dataset()]
        data.PerFrameFunctionalGroupsSequence = frames
        data.PixelData = b"".join(pixels)
        file = self.folder / "enhanced.dcm"
        save(data, file)
        return file


def _file(sop_class: UID, sop: str, syntax: UID = ExplicitVRLittleEndian) -> FileDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = sop_class, sop
    meta.TransferSyntaxUID = syntax
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = sop_class, sop
    for name, value in PERSON.items():
        setattr(data, name, value)
    return data


def save(data: FileDataset, file: Path, preamble: bool = True) -> Path:
    """Write a data set, also one without its 128 bytes and meta header, as old archives hold them."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if preamble:
        pydicom.dcmwrite(file, data, enforce_file_format=True)
    else:
        plain = Dataset(data)
        pydicom.dcmwrite(file, plain, implicit_vr=True, little_endian=True, enforce_file_format=False)
    return file


def edited(file: Path, edit: Callable[[Dataset], object]) -> Path:
    """The file, with its data set changed."""
    data = pydicom.dcmread(file)
    edit(data)
    return save(data, file)


def dicom_bytes(data: FileDataset) -> bytes:
    """A data set as a file in memory."""
    buffer = io.BytesIO()
    pydicom.dcmwrite(buffer, data, enforce_file_format=True)
    return buffer.getvalue()


def write_dicomdir(folder: Path, slices: Iterable[FileDataset]) -> Path:
    """A medium: images in folders of its own, and the DICOMDIR that lists them."""
    files = FileSet()
    for data in slices:
        files.add(data)
    files.write(folder)
    return folder / "DICOMDIR"


def listing_dicomdir(folder: Path, names: Iterable[str | list[str]]) -> Path:
    """A DICOMDIR that lists any names."""
    folder.mkdir(parents=True, exist_ok=True)
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = UID("1.2.840.10008.1.3.10")
    meta.MediaStorageSOPInstanceUID, meta.TransferSyntaxUID = generate_uid(), ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.FileSetID, records = "CD", []
    for name in names:
        record = Dataset()
        record.DirectoryRecordType = "IMAGE"
        record.ReferencedFileID = name
        records.append(record)
    data.DirectoryRecordSequence = records
    path = folder / "DICOMDIR"
    pydicom.dcmwrite(path, data, enforce_file_format=True)
    return path


def zipped(folder: Path, archive: Path) -> Path:
    """All files of a folder in an archive, with their folders."""
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for one in sorted(folder.rglob("*")):
            if one.is_file():
                file.write(one, one.relative_to(folder))
    return archive


def write_segmentation(
    path: Path,
    series: Series,
    masks: dict[str, np.ndarray],
    kind: str = "BINARY",
    slices: Iterable[int] | None = None,
) -> Path:
    """A DICOM-SEG of masks (z, y, x) by their labels; the masks of a FRACTIONAL one are shares from 0 to
    1.
    """
    used = list(range(series.size[2]) if slices is None else slices)
    described = [
        hd.seg.SegmentDescription(
            n,
            label,
            codes.SCT.Organ,
            codes.SCT.Kidney if "idney" in label else codes.SCT.Organ,
            hd.seg.SegmentAlgorithmTypeValues.MANUAL,
        )
        for n, label in enumerate(masks, start=1)
    ]
    pixels = np.stack(list(masks.values()), axis=-1)[used]
    if kind == "LABELMAP":
        pixels = (pixels * np.arange(1, len(masks) + 1)).max(axis=-1)
    segmentation = hd.seg.Segmentation(
        [series.slice(k) for k in used],
        pixels.astype(np.float32 if kind == "FRACTIONAL" else np.uint8),
        hd.seg.SegmentationTypeValues(kind),
        described,
        generate_uid(),
        100,
        generate_uid(),
        1,
        "maker",
        "model",
        "1",
        "0",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    segmentation.save_as(path)
    return path


def write_structures(
    path: Path,
    regions: dict[str, list[np.ndarray]],
    series_uid: str = "",
    kind: str = "CLOSED_PLANAR",
    frame_of_reference: str = "",
    sops: Iterable[str] = (),
    edit: Callable[[FileDataset], None] = lambda data: None,
) -> Path:
    """An RTSTRUCT of closed contours (n, 3) in LPS by the names of their regions, and the CT that it
    refers to.
    """
    data = _file(RTStructureSetStorage, generate_uid(), ImplicitVRLittleEndian)
    data.Modality, data.SeriesInstanceUID, data.SeriesNumber = "RTSTRUCT", generate_uid(), 9
    data.StudyInstanceUID = generate_uid()
    if series_uid or frame_of_reference or sops:
        frame, study, referenced = Dataset(), Dataset(), Dataset()
        if frame_of_reference:
            frame.FrameOfReferenceUID = frame_of_reference
        if series_uid:
            referenced.SeriesInstanceUID = series_uid
        referenced.ContourImageSequence = [_reference(sop) for sop in sops]
        study.ReferencedSOPInstanceUID = generate_uid()
        study.RTReferencedSeriesSequence = [referenced]
        frame.RTReferencedStudySequence = [study]
        data.ReferencedFrameOfReferenceSequence = [frame]
    data.StructureSetROISequence, data.ROIContourSequence = [], []
    for number, (name, contours) in enumerate(regions.items(), start=1):
        roi, drawn = Dataset(), Dataset()
        roi.ROINumber, roi.ROIName = number, name
        if frame_of_reference:
            roi.ReferencedFrameOfReferenceUID = frame_of_reference
        drawn.ReferencedROINumber, drawn.ROIDisplayColor, drawn.ContourSequence = number, [255, 0, 51], []
        for points in contours:
            contour = Dataset()
            contour.ContourGeometricType, contour.NumberOfContourPoints = kind, len(points)
            contour.ContourData = np.round(points, 4).ravel().tolist()
            drawn.ContourSequence.append(contour)
        data.StructureSetROISequence.append(roi)
        data.ROIContourSequence.append(drawn)
    edit(data)
    return save(data, path)


def _reference(sop: str) -> Dataset:
    one = Dataset()
    one.ReferencedSOPClassUID, one.ReferencedSOPInstanceUID = CTImageStorage, sop
    return one
