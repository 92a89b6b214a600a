"""Volumes in one file: NIfTI by nibabel, NRRD and MetaImage by ITK. Headers are doubted before voxels are read."""

from __future__ import annotations

import logging
import re
import warnings
from pathlib import Path
from typing import Any, cast

import nibabel
import numpy as np
import SimpleITK as sitk

from scenes.reading.error import PatientError
from scenes.reading.grid import Box, VoxelGrid
from scenes.reading.volume import Volume

# What is wrong is said in an error.
logging.getLogger("nibabel").setLevel(logging.CRITICAL)

NIFTI = (".nii", ".nii.gz")
ITK = (".nrrd", ".nhdr", ".mha", ".mhd")
MOST_BYTES = 8 * 2**30
# Deflate cannot pack tighter.
MOST_PACKED = 1040
SLAB_VOXELS = 8_000_000
MM_OF_UNIT = {"meter": 1000.0, "micron": 0.001}
SCANNER_CODE = 1
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])
HEADER_BYTES, HEADER_LINE = 1 << 22, 1 << 16
NRRD = (".nrrd", ".nhdr")


def is_volume_file(path: Path) -> bool:
    """Whether a file's name ends as a volume's does."""
    return path.name.lower().endswith((*NIFTI, *ITK))


def file_volume(path: Path) -> Volume:
    """The volume of a file. Raises PatientError: damaged, not 3D, sheared, or without its place in the patient."""
    if path.name.lower().endswith(NIFTI):
        return _nifti(path)
    return _itk(path)


def _nifti(path: Path) -> Volume:
    try:
        image: Any = nibabel.load(path, keep_file_open=True)
        header, shape = image.header, image.shape
        kind = image.get_data_dtype()
    except Exception as error:  # a parser's faults are many; all of them are the file's
        raise PatientError(
            f"{path}: cannot be read as NIfTI ({type(error).__name__}); expected a whole file; copy or export it again"
        ) from error
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        raise PatientError(
            f"{path}: the image has {' x '.join(map(str, shape))} voxels; expected one 3D volume; export one volume"
        )
    if kind.fields or kind.kind not in "iuf":
        raise PatientError(f"{path}: each voxel holds a {kind}; expected one number; export a scalar volume")
    grid = _nifti_grid(path, header, shape).checked(str(path))
    _check_size(path, grid, kind.itemsize, packed=path.name.lower().endswith(".gz"))
    last = (0,) * (len(image.shape) - 3)

    def read_box(box: Box) -> np.ndarray:
        x, y, z = box
        slabs = max(1, SLAB_VOXELS // (grid.size[0] * grid.size[1]))
        planes = []
        try:
            for k in range(z.start, z.stop, slabs):
                part = image.dataobj[(x, y, slice(k, min(k + slabs, z.stop)), *last)]
                planes.append(_narrow(np.asarray(part)).T)
        except Exception as error:  # a parser's faults are many; all of them are the file's
            raise _cut_off(path) from error
        return np.concatenate(planes)

    texts = [
        str(header[key].item(), "latin-1").strip("\0 ")
        for key in ("descrip", "aux_file", "intent_name", "db_name")
        if key in header
    ]
    return Volume(str(path), grid, read_box, secrets=frozenset(text for text in texts if text))


def _narrow(voxels: np.ndarray) -> np.ndarray:
    """Whole numbers as integers: scaled or stored as float64 they take four times the memory."""
    if voxels.dtype.kind != "f" or not np.isfinite(voxels).all():
        return voxels
    whole = np.rint(voxels)
    if np.array_equal(whole, voxels) and np.abs(whole).max(initial=0) < 2**15:
        return whole.astype(np.int16)
    return voxels.astype(np.float32)


def _nifti_grid(path: Path, header: Any, shape: tuple[int, ...]) -> VoxelGrid:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            unit = header.get_xyzt_units()[0]
            codes = int(header["sform_code"]), int(header["qform_code"])
            given = [
                (code, form())
                for code, form in zip(codes, (header.get_sform, header.get_qform), strict=True)
                if code > 0
            ]
        except Exception as error:
            raise PatientError(
                f"{path}: its place in the patient cannot be understood ({type(error).__name__}); export it again"
            ) from error
    if not given:
        raise PatientError(
            f"{path}: says no orientation (sform and qform codes are 0), so left may be right; export it again with its orientation"
        )
    affine = given[0][1]
    if len(given) == 2:
        corners = np.array(np.meshgrid(*[(0, n - 1) for n in shape], [1])).reshape(4, -1)
        apart = np.abs((given[0][1] - given[1][1]) @ corners).max()
        if apart > 0.5 * np.abs(np.diag(affine[:3, :3].T @ affine[:3, :3])).min() ** 0.5:
            scanner = [form for form in given if form[0] == SCANNER_CODE]
            if len(scanner) != 1:
                raise PatientError(
                    f"{path}: sform and qform place it up to {apart:.1f} mm apart; expected one place; export it again"
                )
            affine = scanner[0][1]
    scale = MM_OF_UNIT.get(unit, 1.0)
    columns = RAS_TO_LPS @ affine[:3, :3] * scale
    spacing = np.linalg.norm(columns, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = columns / spacing
    return VoxelGrid(
        cast(tuple[int, int, int], tuple(shape)), spacing, RAS_TO_LPS @ affine[:3, 3] * scale, direction
    )


def _itk(path: Path) -> Volume:
    reader = itk_header(path)
    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    if reader.GetNumberOfComponents() != 1 or "complex" in kind:
        raise PatientError(f"{path}: each voxel holds a {kind}; expected one number; export a scalar volume")
    texts = [text for key, text in metadata(reader).items() if not key.startswith(("NRRD_", "ITK_"))]
    grid = VoxelGrid.of(reader)
    return Volume(str(path), grid, lambda box: _itk_box(path, box), secrets=frozenset(t for t in texts if t))


def itk_header(path: Path) -> sitk.ImageFileReader:
    """The header of an NRRD or MetaImage file, of one component or several. Raises PatientError."""
    data_file = _data_file(path)
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
        size = " x ".join(map(str, reader.GetSize()))
        raise PatientError(f"{path}: the image has {size} voxels; expected one 3D volume; export one volume")
    if path.suffix.lower() in (".nrrd", ".nhdr") and not reader.HasMetaDataKey("NRRD_space"):
        raise PatientError(
            f"{path}: says no space (such as left-posterior-superior), so left may be right; export it again"
        )
    grid = VoxelGrid.of(reader).checked(str(path))
    _check_size(path, grid, _bytes_of(reader), packed=True, held=data_file.stat().st_size)
    return reader


def itk_layers(path: Path) -> list[np.ndarray]:
    """The components (z, y, x) of an NRRD or MetaImage file. Raises PatientError."""
    try:
        voxels = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))
    except RuntimeError as error:
        raise _cut_off(path) from error
    return [voxels] if voxels.ndim == 3 else list(np.moveaxis(voxels, -1, 0))


def _itk_box(path: Path, box: Box) -> np.ndarray:
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetExtractIndex([a.start for a in box])
    reader.SetExtractSize([a.stop - a.start for a in box])
    try:
        return sitk.GetArrayFromImage(reader.Execute())
    except RuntimeError as error:
        raise _cut_off(path) from error


def _cut_off(path: Path) -> PatientError:
    return PatientError(f"{path}: cannot be read to its end; expected a whole file; copy or export it again")


def _check_size(path: Path, grid: VoxelGrid, voxel_bytes: int, packed: bool, held: int | None = None) -> None:
    """Refuse a header that claims more than the file can hold, or than the memory should."""
    claimed = float(np.prod(np.array(grid.size, float))) * voxel_bytes
    held = (path.stat().st_size if held is None else held) * (MOST_PACKED if packed else 1)
    if claimed > min(held, MOST_BYTES):
        size = " x ".join(map(str, grid.size))
        raise PatientError(
            f"{path}: its header claims {size} voxels, more than the file can hold; copy or export it again"
        )


def _data_file(path: Path) -> Path:
    """The file with a header's voxels: the same, or one beside it. Raises PatientError: elsewhere, or several."""
    nrrd = path.suffix.lower() in NRRD
    found: list[str] = []
    dimensions: list[str] = []
    with path.open("rb") as file:
        while len(line := file.readline(HEADER_LINE)) < HEADER_LINE and file.tell() < HEADER_BYTES:
            text = line.decode("latin-1")
            if not line or (nrrd and not text.strip("\r\n")):
                break
            colon, equals = text.find(":"), text.find("=")
            at = min((a for a in (colon, colon if nrrd else equals) if a >= 0), default=-1)
            key, value = text[:at].strip().lower().replace(" ", ""), text[at + 1 :].strip(" \t\r\n=")
            if at >= 0 and key == "ndims":
                dimensions.append(value)
            if at >= 0 and key in ("datafile", "elementdatafile"):
                found.append(value)
                if not nrrd:
                    break
        else:
            raise PatientError(f"{path}: its header has no end; expected a few lines; export it again")
    if not nrrd and (len(found) != 1 or dimensions != ["3"]):
        raise PatientError(
            f"{path}: its header says {' and '.join(dimensions)[:20] or 'no'} dimensions; expected one 3D volume, and where its "
            "voxels lie; export one volume"
        )
    if found in ([], ["LOCAL"], ["local"]):
        return path
    name = found[0]
    plain = name.isprintable() and len(name) < 256 and not name.upper().startswith("LIST") and "%" not in name
    beside = (path.parent / name).resolve() if plain else path
    if not plain or len(found) > 1 or not beside.is_relative_to(path.parent.resolve()):
        raise PatientError(
            f"{path}: its voxels lie in {name[:60]!r}; expected one file beside it; convert it to one NRRD file"
        )
    if not beside.is_file():
        raise PatientError(
            f"{path}: its voxels should lie in {name[:60]!r}, which is not there; copy both files"
        )
    return beside


def metadata(reader: sitk.ImageFileReader) -> dict[str, str]:
    """What a header says; keys that are no text say nothing."""
    return {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys() if key.isprintable()}


def _bytes_of(reader: sitk.ImageFileReader) -> int:
    """Bytes of one voxel with all its components."""
    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    bits = re.search(r"(\d+)-bit", kind)
    return reader.GetNumberOfComponents() * (int(bits[1]) // 8 if bits else 8)
