"""Read NRRD and MetaImage with ITK, after checks of what ITK trusts: the header, and which file holds the voxels."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from errors import PatientError
from scenes.volumes.lazy_volume import LazyVolume, check_size, cut_off, no_scalar, not_3d
from scenes.volumes.voxel_grid import Box, VoxelGrid

NRRD, META = (".nrrd", ".nhdr"), (".mha", ".mhd")
HEADER_BYTES, LINE_BYTES, NAME_LETTERS = 1 << 22, 1 << 16, 255


def itk_volume(path: Path) -> LazyVolume:
    """Read the header of a scalar volume; voxels are read on demand. Raises PatientError."""
    reader = itk_header(path)
    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    if reader.GetNumberOfComponents() != 1 or "complex" in kind:
        raise no_scalar(path, kind)
    texts = [text for key, text in metadata(reader).items() if not key.startswith(("NRRD_", "ITK_"))]
    grid = VoxelGrid.of(reader)
    return LazyVolume(
        str(path), grid, lambda box: _itk_box(path, box), identifiers=frozenset(t for t in texts if t)
    )


def itk_header(path: Path) -> sitk.ImageFileReader:
    """The header of an NRRD or MetaImage file, of one component or several. Raises PatientError."""
    data_file = file_with_voxels(path)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NrrdImageIO" if path.suffix.lower() in NRRD else "MetaImageIO")
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise PatientError(
            f"{path}: cannot be read as an image; expected a whole file of its kind; copy or export it again"
        ) from error
    if reader.GetDimension() != 3:
        raise not_3d(path, reader.GetSize())
    if path.suffix.lower() in NRRD and not reader.HasMetaDataKey("NRRD_space"):
        raise PatientError(
            f"{path}: has no space field (such as left-posterior-superior), so left and right may be exchanged; export it again"
        )
    grid = VoxelGrid.of(reader).checked(str(path))
    check_size(path, grid, _bytes_of(reader), data_file.stat().st_size, compressed=True)
    return reader


def itk_layers(path: Path) -> list[np.ndarray]:
    """The components (z, y, x) of an NRRD or MetaImage file. Raises PatientError."""
    try:
        voxels = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))
    except RuntimeError as error:
        raise cut_off(path) from error
    return [voxels] if voxels.ndim == 3 else list(np.moveaxis(voxels, -1, 0))


def _itk_box(path: Path, box: Box) -> np.ndarray:
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetExtractIndex([a.start for a in box])
    reader.SetExtractSize([a.stop - a.start for a in box])
    try:
        return sitk.GetArrayFromImage(reader.Execute())
    except RuntimeError as error:
        raise cut_off(path) from error


def metadata(reader: sitk.ImageFileReader) -> dict[str, str]:
    """The metadata of a header whose keys are printable."""
    return {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys() if key.isprintable()}


def _bytes_of(reader: sitk.ImageFileReader) -> int:
    """Bytes of one voxel with all its components."""
    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    bits = re.search(r"(\d+)-bit", kind)
    return reader.GetNumberOfComponents() * (int(bits[1]) // 8 if bits else 8)


def file_with_voxels(path: Path) -> Path:
    """The file that holds the voxels of a header: the same, or one in its folder.

    Raises PatientError: elsewhere, several files, or a MetaImage that is not 3D, which makes ITK crash.
    """
    fields = list(_header_fields(path))
    names = [value for key, value in fields if key in ("datafile", "elementdatafile")]
    if path.suffix.lower() in META:
        dimensions = [value for key, value in fields if key == "ndims"]
        if len(names) != 1 or dimensions != ["3"]:
            found = " and ".join(dimensions)[:20] or "no"
            raise PatientError(
                f"{path}: its header has {found} dimensions; expected one 3D volume and one file with its voxels; export one volume"
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
            f"{path}: its voxels are in {name[:60]!r}; expected one file in the same folder; convert it to one NRRD file"
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
