"""NRRD and segmentations of 3D Slicer as text of their own, not by the library that reads them."""

import gzip
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from scenes.volumes.voxel_grid import VoxelGrid


def write_nrrd(
    path: Path,
    grid: VoxelGrid,
    voxels: np.ndarray,
    space: str = "space: left-posterior-superior",
    signs: np.ndarray | tuple[int, int, int] = (1, 1, 1),
    fields: Iterable[str] = (),
) -> Path:
    """Voxels (z, y, x), or (z, y, x, n) of n layers, whose axes are those of a grid, in a space of the given
    signs along LPS; with further lines of the header.
    """
    signs = np.asarray(signs)
    has_layers = voxels.ndim == 4
    directions = " ".join(map(_vector, (signs[:, None] * grid.direction * grid.spacing).T))
    lines = [
        "NRRD0004",
        "# as 3D Slicer writes it",
        f"type: {voxels.dtype.name}",
        f"dimension: {voxels.ndim}",
        space,
        f"sizes: {' '.join(map(str, voxels.shape[::-1]))}",
        f"space directions: {'none ' * has_layers}{directions}",
        f"kinds: {'list ' * has_layers}domain domain domain",
        "endian: little",
        "encoding: gzip",
        f"space origin: {_vector(signs * grid.origin)}",
        *fields,
    ]
    path.write_bytes("\n".join([*lines, "", ""]).encode("latin-1") + gzip.compress(voxels.tobytes()))
    return path


def _vector(numbers: np.ndarray) -> str:
    return f"({','.join(map(repr, np.asarray(numbers, float).tolist()))})"


def segment_lines(segments: Iterable[Mapping[str, object]]) -> list[str]:
    """The lines of a header that describe segments."""
    return [f"Segment{n}_{key}:={text}" for n, one in enumerate(segments) for key, text in one.items()]


def with_segments(image: sitk.Image, segments: Iterable[Mapping[str, object]]) -> sitk.Image:
    """The image with the fields of segments, as ITK writes them."""
    for line in segment_lines(segments):
        image.SetMetaData(*line.split(":=", 1))
    return image
