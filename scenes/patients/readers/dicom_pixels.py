"""Decode CT slices to HU: with pydicom and its plugins, else with the GDCM of SimpleITK."""

from collections.abc import Iterable, Iterator
from itertools import groupby

import numpy as np
import SimpleITK as sitk
from pydicom.dataset import Dataset
from pydicom.pixels import pixel_array

from errors import PatientError, parsing
from scenes.atomic_files import plain_path
from scenes.patients.readers.dicom_files import SourceFile
from scenes.patients.readers.dicom_headers import DicomSlice
from scenes.volumes.lazy_volume import AIR_HU, LEAST_HU, MOST_HU


def hounsfield(slices: Iterable[DicomSlice]) -> Iterator[np.ndarray]:
    """HU (rows, columns) int16 of each slice; padding becomes air.

    Raises PatientError that names the file.
    """
    for item, of_file in groupby(slices, key=lambda one: one.item):
        data, by_gdcm = item.parsed(), None
        _check_length(item, data)
        syntax = getattr(data.file_meta.get("TransferSyntaxUID"), "name", "of no stated transfer syntax")
        fault = f"{item.name}: the pixels cannot be decoded ({syntax})"
        for one in of_file:
            with parsing(fault, "expected a whole CT slice; export it again, uncompressed"):
                try:
                    raw = pixel_array(data, index=one.frame)
                except RuntimeError:  # no plugin of pydicom decodes it
                    by_gdcm = _decoded_by_gdcm(item, fault) if by_gdcm is None else by_gdcm
                    # GDCM applies one slope and intercept to the file.
                    values = np.array(by_gdcm[one.frame or 0], np.float32)
                else:
                    values = raw * np.float32(one.slope) + np.float32(one.intercept)
                    if one.padding:
                        values[_padded(raw, one.padding)] = AIR_HU
            if values.shape != (one.rows, one.columns):
                raise PatientError(
                    f"{item.name}: it has pixels of shape {values.shape}; expected "
                    f"{(one.rows, one.columns)}, as in its header; export it "
                    "again"
                )
            yield np.clip(np.rint(values), LEAST_HU, MOST_HU).astype(np.int16)


def _check_length(item: SourceFile, data: Dataset) -> None:
    """Raises PatientError where uncompressed pixels are a row or column too many: of other Columns every
    row would be shifted.
    """
    syntax = data.file_meta.get("TransferSyntaxUID")
    if syntax is None or not syntax.is_transfer_syntax or syntax.is_encapsulated or "PixelData" not in data:
        return
    if data.get("BitsAllocated") == 1:  # of a segmentation: packed over the ends of frames
        return
    with parsing(
        f"{item.name}: Rows, Columns, BitsAllocated or NumberOfFrames cannot be read",
        "expected whole numbers",
    ):
        rows, columns = int(data.Rows), int(data.Columns)
        pixels, of_pixel = rows * columns * int(data.get("NumberOfFrames") or 1), int(data.BitsAllocated) // 8
    if len(data.PixelData) >= of_pixel * (pixels + min(rows, columns)):
        raise PatientError(
            f"{item.name}: PixelData has {len(data.PixelData)} bytes; expected {of_pixel * pixels}, by its "
            "Rows, Columns, BitsAllocated "
            "and NumberOfFrames; export it again"
        )


def _decoded_by_gdcm(item: SourceFile, fault: str) -> np.ndarray:
    if item.path is None:
        raise PatientError(f"{fault}; its compression is rare: extract the archive and give the folder")
    with plain_path(item.path) as name:
        return sitk.GetArrayFromImage(sitk.ReadImage(name))


def _padded(raw: np.ndarray, padding: tuple[int, int]) -> np.ndarray:
    """Mask of padding; the tag and the pixels may differ in signedness."""
    low, high = padding
    if low == high:
        return (raw.astype(np.int64) & 0xFFFF) == (low & 0xFFFF)
    return (raw >= low) & (raw <= high)
