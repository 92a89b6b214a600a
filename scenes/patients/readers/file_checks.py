"""What is doubted of every file with a volume before and while its voxels are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scenes.patients.import_error import PatientError
from scenes.patients.readers.voxel_grid import VoxelGrid

MOST_BYTES = 8 * 2**30
# Deflate cannot pack tighter.
MOST_PACKED = 1040


def check_size(path: Path, grid: VoxelGrid, voxel_bytes: int, held_bytes: int, packed: bool) -> None:
    """Refuse a header that claims more than the file can hold, or than the memory should. Raises PatientError."""
    claimed = float(np.prod(np.array(grid.size, float))) * voxel_bytes
    if claimed > min(held_bytes * (MOST_PACKED if packed else 1), MOST_BYTES):
        size = " x ".join(map(str, grid.size))
        raise PatientError(
            f"{path}: its header claims {size} voxels, more than the file can hold; copy or export it again"
        )


def not_3d(path: Path, shape: tuple[int, ...]) -> PatientError:
    """The refusal of an image that is no volume."""
    size = " x ".join(map(str, shape))
    return PatientError(f"{path}: the image has {size} voxels; expected one 3D volume; export one volume")


def no_scalar(path: Path, kind: object) -> PatientError:
    """The refusal of an image whose voxels are colours, vectors or complex."""
    return PatientError(f"{path}: each voxel holds a {kind}; expected one number; export a scalar volume")


def cut_off(path: Path) -> PatientError:
    """The refusal of a file that ends too early."""
    return PatientError(f"{path}: cannot be read to its end; expected a whole file; copy or export it again")
