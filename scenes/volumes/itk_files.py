"""Read NRRD and MetaImage with ITK, after checks of what ITK trusts: the header, and which file holds the
voxels.
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from errors import PatientError, parsing
from scenes.atomic_files import plain_path
from scenes.patient_space import Space
from scenes.volumes.lazy_volume import LazyVolume, check_size, no_orientation, no_scalar
from scenes.volumes.voxel_grid import Box, VoxelGrid, check_3d

NRRD, META = (".nrrd", ".nhdr"), (".mha", ".mhd")
# Of MetaImage, as MetaIO reads them.
ORIENTATION_FIELDS = {"transformmatrix", "rotation", "orientation"}
# Those that the format has, and their abbreviations (teem.sourceforge.net/nrrd/format.html#space).
SPACES_OF_NRRD = {
    *("right-anterior-superior", "ras", "left-anterior-superior", "las", "left-posterior-superior", "lps"),
    *("right-anterior-superior-time", "rast", "left-anterior-superior-time", "last",
    "left-posterior-superior-time", "lpst"),
    *("scanner-xyz", "scanner-xyz-time", "3d-right-handed", "3d-left-handed", "3d-right-handed-time",
    "3d-left-handed-time"),
}  # fmt: skip
HEADER_BYTES, LINE_BYTES, NAME_LETTERS = 1 << 22, 1 << 16, 255


def itk_volume(path: Path, vectors: bool = False, space: Space | None = None) -> LazyVolume:
    """Read the header of an NRRD or MetaImage file; voxels (z, y, x), of vectors (z, y, x, n), are read on
    demand.

    ``space`` is that of a file that names none. Raises PatientError where it is damaged, not 3D, of several
    numbers per voxel but for ``vectors``, or without a place in the patient.
    """
    data_file = file_with_voxels(path)
    _check_space(path)
    is_nrrd = path.suffix.lower() in NRRD
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NrrdImageIO" if is_nrrd else "MetaImageIO")
    failed = f"{path}: cannot be read as an image"
    with (
        plain_path(path, data_file) as name,
        parsing(failed, "expected a whole file; copy or export it again"),
    ):
        reader.SetFileName(name)
        reader.ReadImageInformation()
    check_3d(str(path), reader.GetSize())
    missing = _missing_orientation(path, reader)
    if missing and space is None:
        raise no_orientation(path, missing)
    assumed = space if missing else None
    grid = VoxelGrid.of(reader).in_lps(assumed or "LPS").checked(str(path))
    kind, components = sitk.GetPixelIDValueAsString(reader.GetPixelID()), reader.GetNumberOfComponents()
    bits = re.search(r"(\d+)-bit", kind)
    voxel_bytes = components * (int(bits[1]) // 8 if bits else 8)
    check_size(path, grid, voxel_bytes, data_file.stat().st_size, compressed=True)
    if (components != 1 and not vectors) or "complex" in kind:
        raise no_scalar(path, kind)
    metadata = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys() if key.isprintable()}
    return LazyVolume(str(path), grid, partial(_itk_box, path, data_file), space=assumed, metadata=metadata)


def _check_space(path: Path) -> None:
    """Raises PatientError for an NRRD whose space is none of the format's, which ITK does not read."""
    named = dict(_header_fields(path)).get("space", "") if path.suffix.lower() in NRRD else ""
    if named and named.casefold() not in SPACES_OF_NRRD:
        raise PatientError(
            f"{path}: its field space is {named[:60]!r}, which NRRD does not have; expected such as "
            "left-posterior-superior; export it again, "
            "for example from 3D Slicer, or correct the field"
        )


def _missing_orientation(path: Path, reader: sitk.ImageFileReader) -> str:
    """What a header lacks to say where its axes point in the patient; "" where it lacks nothing."""
    if path.suffix.lower() in META:
        is_there = any(key in ORIENTATION_FIELDS for key, _ in _header_fields(path))
        return "" if is_there else "has no TransformMatrix"
    if not reader.HasMetaDataKey("NRRD_space"):
        return "has no space field (such as left-posterior-superior)"
    # ITK has converted the anatomical ones to this.
    if (space := reader.GetMetaData("NRRD_space")) != "left-posterior-superior":
        return (
            f"its space is {space}, which names no axes of the patient (expected such as "
            "left-posterior-superior)"
        )
    return ""


def _itk_box(path: Path, data_file: Path, box: Box) -> np.ndarray:
    reader = sitk.ImageFileReader()
    reader.SetExtractIndex([a.start for a in box])
    reader.SetExtractSize([a.stop - a.start for a in box])
    failed = f"{path}: cannot be read to its end"
    with (
        plain_path(path, data_file) as name,
        parsing(failed, "expected a whole file; copy or export it again"),
    ):
        reader.SetFileName(name)
        return sitk.GetArrayFromImage(reader.Execute())


def file_with_voxels(path: Path) -> Path:
    """The file that holds the voxels of a header: the same, or one in its folder.

    Raises PatientError where it is elsewhere or in several files, or a MetaImage is not 3D, which makes ITK
    crash.
    """
    fields = list(_header_fields(path))
    names = [value for key, value in fields if key in ("datafile", "elementdatafile")]
    if path.suffix.lower() in META:
        dimensions = [value for key, value in fields if key == "ndims"]
        if len(names) != 1 or dimensions != ["3"]:
            count = " and ".join(dimensions)[:20] or "no"
            raise PatientError(
                f"{path}: its header has {count} dimensions; expected one 3D volume and one file with its "
                "voxels; export one volume"
            )
    if not names or names in (["LOCAL"], ["local"]):
        return path
    name = names[0]
    is_plain = (
        name.isprintable() and len(name) <= NAME_LETTERS and "%" not in name and name[:4].upper() != "LIST"
    )
    beside = (path.parent / name).resolve() if is_plain else path
    if not is_plain or len(names) > 1 or not beside.is_relative_to(path.parent.resolve()):
        raise PatientError(
            f"{path}: its voxels are in {name[:60]!r}; expected one file in the same folder; convert it to "
            "one NRRD file"
        )
    if not beside.is_file():
        raise PatientError(f"{path}: its voxels are in {name[:60]!r}, which is missing; copy both files")
    return beside


def _header_fields(path: Path) -> Iterator[tuple[str, str]]:
    """Keys and values of a header, split as ITK does. Raises PatientError where the header has no end."""
    is_nrrd = path.suffix.lower() in NRRD
    with path.open("rb") as file:
        while len(line := file.readline(LINE_BYTES)) < LINE_BYTES and file.tell() < HEADER_BYTES:
            text = line.decode("latin-1")
            if not line or (is_nrrd and not text.strip("\r\n")):
                return
            places = [at for at in (text.find(":"), -1 if is_nrrd else text.find("=")) if at >= 0]
            if not places:
                continue
            key = text[: min(places)].strip().lower().replace(" ", "")
            yield key, text[min(places) + 1 :].strip(" \t\r\n=")
            if key == "elementdatafile" and not is_nrrd:
                return
    raise PatientError(f"{path}: its header has no end; expected a few lines; export it again")
