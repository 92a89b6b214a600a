"""Reading a CT or a label map: DICOM folder, NIfTI, NRRD, MetaImage; what misleads is refused in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import SimpleITK as sitk
from pydicom.errors import InvalidDicomError

FILE_ENDINGS = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
# Part of a slice distance by which a slice may lie off the even grid: scanners round positions, to 0.1 mm at
# worst, and a missing slice is off by a whole distance.
UNEVEN = 0.1

GEOMETRY_TAGS = [
    "Modality",
    "SeriesInstanceUID",
    "SeriesNumber",
    "ImagePositionPatient",
    "ImageOrientationPatient",
    "PixelSpacing",
    "NumberOfFrames",
    "Rows",
    "Columns",
]


class PatientError(ValueError):
    """One line for the user: which file, what was found, what was expected, what to do."""


def read_volume(path: Path) -> sitk.Image:
    """Read a scalar 3D volume with its place in the patient.

    Args:
        path: folder with one CT series, or a .nii, .nii.gz, .nrrd, .nhdr, .mha or .mhd file.

    Returns:
        Image whose spacing, origin and direction are LPS [mm]; a CT's values are HU. No metadata.

    Raises:
        PatientError: nothing readable there, not one evenly spaced CT series, not a scalar 3D volume, or
            values that are not finite.
    """
    path = Path(path)
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_dir():
        image = _read_series(path)
    elif path.name.lower().endswith(FILE_ENDINGS):
        image = _read_file(path)
    else:
        if path.suffix.lower() == ".dcm":
            raise PatientError(
                f"{path}: is one slice of a DICOM series; give the folder that holds all of them"
            )
        raise PatientError(
            f"{path}: unknown kind of file; expected a folder with a DICOM series, or a file that ends in "
            f"{', '.join(FILE_ENDINGS)}; convert it"
        )
    return _checked(image, path)


def _read_file(path: Path) -> sitk.Image:
    try:
        return sitk.ReadImage(str(path))
    except RuntimeError as error:
        raise PatientError(
            f"{path}: cannot be read as an image ({_last_line(error)}); expected a whole file of "
            "its kind; copy or export it again"
        ) from error


def _checked(image: sitk.Image, path: Path) -> sitk.Image:
    if image.GetDimension() != 3 or min(image.GetSize()) < 2:
        size = " x ".join(str(n) for n in image.GetSize())
        raise PatientError(f"{path}: the image has {size} voxels; expected one 3D volume; export one volume")
    if image.GetNumberOfComponentsPerPixel() != 1 or "complex" in image.GetPixelIDTypeAsString():
        raise PatientError(
            f"{path}: each voxel holds a {image.GetPixelIDTypeAsString()}; expected one number; export a "
            "scalar volume"
        )
    voxels = sitk.GetArrayFromImage(image)
    if not np.isfinite(voxels).all():
        count = int((~np.isfinite(voxels)).sum())
        raise PatientError(f"{path}: {count} voxels are not finite numbers; export the volume again")
    bare = sitk.GetImageFromArray(voxels)
    bare.CopyInformation(image)
    return bare


def _read_series(folder: Path) -> sitk.Image:
    headers = _headers(folder)
    _check_one_ct(folder, headers)
    ordered = _check_even(folder, headers)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(file) for file in ordered])
    try:
        return reader.Execute()
    except RuntimeError as error:
        raise PatientError(
            f"{folder}: the slices cannot be decoded ({_last_line(error)}); expected whole CT slices; "
            "export the series again, uncompressed"
        ) from error


def _headers(folder: Path) -> dict[Path, pydicom.Dataset]:
    """Geometry tags of every DICOM file in the folder, which may hold other files too."""
    headers: dict[Path, pydicom.Dataset] = {}
    for file in sorted(entry for entry in folder.iterdir() if entry.is_file()):
        try:
            header = pydicom.dcmread(file, stop_before_pixels=True, specific_tags=GEOMETRY_TAGS)
        except (InvalidDicomError, OSError, EOFError):
            continue
        if "SeriesInstanceUID" in header:
            headers[file] = header
    if not headers:
        raise PatientError(
            f"{folder}: no DICOM file in this folder; give the folder that holds the slices itself"
        )
    return headers


def _check_one_ct(folder: Path, headers: dict[Path, pydicom.Dataset]) -> None:
    series: dict[str, list[Path]] = {}
    for file, header in headers.items():
        series.setdefault(str(header.SeriesInstanceUID), []).append(file)
    if len(series) > 1:
        named = "; ".join(
            f"series {headers[files[0]].get('SeriesNumber', '?')} ({headers[files[0]].get('Modality', '?')}, "
            f"{len(files)} files, first {files[0].name})"
            for files in series.values()
        )
        raise PatientError(
            f"{folder}: {len(series)} series, expected one: {named}; put the slices of one series in a "
            "folder of their own"
        )
    for file, header in headers.items():
        modality = header.get("Modality", "none")
        if modality != "CT":
            raise PatientError(
                f"{file}: the modality is {modality}; expected CT; give the folder of a CT series"
            )
        if int(header.get("NumberOfFrames") or 1) > 1:
            raise PatientError(
                f"{file}: holds {header.NumberOfFrames} frames; expected one slice a file; convert it to "
                "NRRD or NIfTI"
            )
        if "ImagePositionPatient" not in header or "ImageOrientationPatient" not in header:
            raise PatientError(
                f"{file}: says no position in the patient; remove it, or export the series again"
            )


def _check_even(folder: Path, headers: dict[Path, pydicom.Dataset]) -> list[Path]:
    """Files from first to last slice, once they are known to be parallel, unsheared and evenly spaced."""
    files = list(headers)
    if len(files) < 2:
        raise PatientError(
            f"{folder}: one slice only; expected a series of slices; give the folder of the whole series"
        )
    shapes = {
        (
            h.get("Rows"),
            h.get("Columns"),
            *np.round(np.array(h.get("PixelSpacing", [0, 0]), float), 4).tolist(),
        )
        for h in headers.values()
    }
    orientations = np.array([headers[f].ImageOrientationPatient for f in files], float)
    if len(shapes) > 1 or np.abs(orientations - orientations[0]).max() > 1e-3:
        raise PatientError(
            f"{folder}: slices of different size, pixel spacing or orientation; expected one stack; remove "
            "localisers and other views"
        )
    positions = np.array([headers[f].ImagePositionPatient for f in files], float)
    normal = np.cross(orientations[0, :3], orientations[0, 3:])
    along = positions @ normal
    order = np.argsort(along, kind="stable")
    files, along, positions = [files[n] for n in order], along[order], positions[order]

    gaps = np.diff(along)
    usual = float(np.median(gaps))
    _check_gaps(files, gaps, usual)
    across = (positions - positions[0]) - np.outer(along - along[0], normal)
    even = np.abs(along - np.linspace(along[0], along[-1], len(along))).max()
    if even > UNEVEN * usual:
        raise PatientError(
            f"{folder}: slices lie up to {even:.2f} mm off an even spacing of {usual:.2f} mm; expected even "
            "gaps; export an evenly spaced series"
        )
    shift = float(np.linalg.norm(across, axis=1).max())
    if shift > UNEVEN * usual:
        raise PatientError(
            f"{folder}: slices are shifted sideways by up to {shift:.1f} mm (gantry tilt); expected an "
            "upright stack; resample the series, for example in 3D Slicer"
        )
    return files


def _check_gaps(files: list[Path], gaps: np.ndarray, usual: float) -> None:
    if gaps.min() < 1e-3:
        n = int(np.argmin(gaps))
        raise PatientError(
            f"{files[n]} and {files[n + 1].name} lie at one position; expected each slice once; remove "
            "duplicates and other phases"
        )
    if gaps.max() > 1.5 * usual:
        n = int(np.argmax(gaps))
        raise PatientError(
            f"{files[n]} and {files[n + 1].name} are {gaps[n]:.2f} mm apart, the others {usual:.2f} mm; "
            "expected no slice to be missing; copy the whole series"
        )


def _last_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__)[:160]
