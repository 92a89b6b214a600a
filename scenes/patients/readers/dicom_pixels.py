"""Decode CT slices to HU: with pydicom and its plugins, else with the GDCM of SimpleITK."""

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import SimpleITK as sitk
from pydicom.dataset import Dataset
from pydicom.pixels import pixel_array

from errors import PatientError
from scenes.patients.readers.dicom_file import parse_dicom
from scenes.patients.readers.dicom_headers import DicomSlice
from scenes.patients.readers.dicom_source import SourceFile
from scenes.volumes.lazy_volume import AIR_HU, LEAST_HU, MOST_HU


def hounsfield(slices: list[DicomSlice]) -> Iterator[np.ndarray]:
    """HU (rows, columns) int16 of each slice; padding becomes air. Raises PatientError that names the file."""
    file = None
    for one in slices:
        if file is None or file.item is not one.item:
            file = _ParsedFile(one.item)
        yield file.hounsfield(one)


class _ParsedFile:
    """One parsed DICOM file, which may have many slices."""

    def __init__(self, item: SourceFile) -> None:
        self.item = item
        with item.open() as opened:
            self.data: Dataset = parse_dicom(opened, item.name)
        self.by_gdcm: np.ndarray | None = None

    def hounsfield(self, one: DicomSlice) -> np.ndarray:
        raw = self._raw(one)
        if raw is None:
            values = self._gdcm(one)
        else:
            values = raw * np.float32(one.slope) + np.float32(one.intercept)
            if one.padding:
                values[_padded(raw, one.padding)] = AIR_HU
        if values.shape != (one.rows, one.columns):
            raise PatientError(
                f"{self.item.name}: it has pixels of shape {values.shape}, expected {(one.rows, one.columns)}, as in its header"
            )
        return np.clip(np.rint(values), LEAST_HU, MOST_HU).astype(np.int16)

    def _raw(self, one: DicomSlice) -> np.ndarray | None:
        """Stored values; None where no pydicom plugin decodes them."""
        options: dict[str, Any] = {} if one.frame is None else {"index": one.frame}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return pixel_array(self.data, **options)
            except RuntimeError:
                return None
            except Exception as error:
                raise self._fault(type(error).__name__) from error

    def _gdcm(self, one: DicomSlice) -> np.ndarray:
        if self.item.path is None:
            raise self._fault("its compression is rare: extract the archive and give the folder")
        if self.by_gdcm is None:
            try:
                self.by_gdcm = sitk.GetArrayFromImage(sitk.ReadImage(str(self.item.path)))
            except RuntimeError as error:
                raise self._fault("no decoder can read it") from error
        # GDCM applies one slope and intercept to the file.
        return np.array(self.by_gdcm[one.frame or 0], np.float32)

    def _fault(self, why: str) -> PatientError:
        syntax = self.data.file_meta.get("TransferSyntaxUID") if "file_meta" in vars(self.data) else None
        name = getattr(syntax, "name", "of no stated transfer syntax")
        return PatientError(
            f"{self.item.name}: the pixels cannot be decoded ({name}; {why}); expected a whole CT slice; "
            "export it again, uncompressed"
        )


def _padded(raw: np.ndarray, padding: tuple[int, int]) -> np.ndarray:
    """Mask of padding; the tag and the pixels may differ in signedness."""
    low, high = padding
    if low == high:
        return (raw.astype(np.int64) & 0xFFFF) == (low & 0xFFFF)
    return (raw >= low) & (raw <= high)
