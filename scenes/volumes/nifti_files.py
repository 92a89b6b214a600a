"""Read NIfTI with nibabel: RAS becomes LPS; a file without an orientation is refused."""

import contextlib
import logging
import re
from pathlib import Path
from typing import Any, cast

import nibabel
import numpy as np

from errors import PatientError, parsing
from scenes.patient_space import Space
from scenes.volumes.lazy_volume import LazyVolume, check_size, no_orientation, no_scalar
from scenes.volumes.voxel_grid import Box, VoxelGrid, check_3d

# Problems are reported as errors here.
logging.getLogger("nibabel").setLevel(logging.CRITICAL)

SLAB_VOXELS = 8_000_000
# A pattern, no XML parser: an extension may contain anything, and only the names are needed.
LABEL_ENTRY = re.compile(r'<Label\s[^<>]*?Key="(\d{1,5})"[^<>]*>(?:<!\[CDATA\[)?([^<>\]]{1,200})')
MOST_NAMES_BYTES = 1 << 20
MM_OF_UNIT = {"meter": 1000.0, "micron": 0.001}
SCANNER_CODE = 1
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])


def nifti_volume(path: Path, space: Space | None = None) -> LazyVolume:
    """Read the header of a volume; voxels are read on demand. ``space`` is that of a file without an
    orientation.

    Raises PatientError where it is damaged, not 3D, sheared, or without an orientation.
    """
    with parsing(f"{path}: cannot be read as NIfTI", "expected a whole file; copy or export it again"):
        image: Any = nibabel.load(path, keep_file_open=True)
        header, shape = image.header, image.shape
        kind = image.get_data_dtype()
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    check_3d(str(path), shape)
    if kind.fields or kind.kind not in "iuf":
        raise no_scalar(path, kind)
    grid, assumed = _grid(path, header, shape, space)
    grid.checked(str(path))
    check_size(path, grid, kind.itemsize, path.stat().st_size, compressed=path.name.lower().endswith(".gz"))
    last = (0,) * (len(image.shape) - 3)

    def read_box(box: Box) -> np.ndarray:
        x, y, z = box
        slabs = max(1, SLAB_VOXELS // (grid.size[0] * grid.size[1]))
        planes = []
        with parsing(f"{path}: cannot be read to its end", "expected a whole file; copy or export it again"):
            for k in range(z.start, z.stop, slabs):
                part = image.dataobj[(x, y, slice(k, min(k + slabs, z.stop)), *last)]
                planes.append(_narrow(np.asarray(part)).T)
        return np.concatenate(planes)

    return LazyVolume(str(path), grid, read_box, space=assumed, metadata=_label_names(header))


def _label_names(header: Any) -> dict[str, str]:
    """Names of label values from the header extension of Connectome Workbench, which TotalSegmentator
    writes.
    """
    names: dict[str, str] = {}
    with contextlib.suppress(Exception):  # a damaged extension has no names
        for extension in header.extensions:
            text = extension.get_content()
            plain = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)
            for key, name in LABEL_ENTRY.findall(plain[:MOST_NAMES_BYTES]):
                names[key] = name.strip()
    return names


def _narrow(voxels: np.ndarray) -> np.ndarray:
    """Integral values as int16, others as float32: float64 takes up to four times the memory."""
    if voxels.dtype.kind != "f" or not np.isfinite(voxels).all():
        return voxels
    integral = np.rint(voxels)
    if np.array_equal(integral, voxels) and np.abs(integral).max(initial=0) < 2**15:
        return integral.astype(np.int16)
    return voxels.astype(np.float32)


def _grid(
    path: Path, header: Any, shape: tuple[int, ...], space: Space | None
) -> tuple[VoxelGrid, Space | None]:
    """The grid, and the given space where the header has no orientation."""
    with parsing(f"{path}: its position in the patient cannot be read", "export it again"):
        unit = header.get_xyzt_units()[0]
        forms = (
            (int(header["sform_code"]), header.get_sform()),
            (int(header["qform_code"]), header.get_qform()),
        )
    scale = MM_OF_UNIT.get(unit, 1.0)
    size = cast(tuple[int, int, int], tuple(shape))
    stated = [form for form in forms if form[0] > 0]
    if not stated and space is None:
        raise no_orientation(path, "has no orientation (sform and qform codes are 0)")
    if not stated:
        zooms = np.array([float(n) for n in header.get_zooms()[:3]]) * scale
        return VoxelGrid(size, zooms, np.zeros(3), np.eye(3)).in_lps(space or "LPS"), space
    affine = _affine(path, stated, shape)
    columns = RAS_TO_LPS @ affine[:3, :3] * scale
    spacing = np.linalg.norm(columns, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = columns / spacing
    return VoxelGrid(size, spacing, RAS_TO_LPS @ affine[:3, 3] * scale, direction), None


def _affine(path: Path, forms: list[tuple[int, np.ndarray]], shape: tuple[int, ...]) -> np.ndarray:
    """The affine (4, 4) from indices to RAS, of sform and qform; the scanner's where they disagree."""
    affine = forms[0][1]
    corners = np.array(np.meshgrid(*[(0, n - 1) for n in shape], [1])).reshape(4, -1)
    apart = max(np.abs((affine - other) @ corners).max() for _, other in forms)
    if apart <= 0.5 * np.linalg.norm(affine[:3, :3], axis=0).min():
        return affine
    scanner = [other for code, other in forms if code == SCANNER_CODE]
    if len(scanner) != 1:
        raise PatientError(
            f"{path}: sform and qform differ by up to {apart:.1f} mm; expected one position; export it again"
        )
    return scanner[0]
