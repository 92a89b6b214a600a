"""Bones of a CT, with their marrow, by HU and shape."""

import numpy as np
from scipy import ndimage
from skimage.measure import block_reduce

# Cortical bone; what only bone reaches; the least volume of that which is no stone or calcified vessel.
SHELL_ABOVE_HU, BONE_ABOVE_HU, MIN_BONE_ML = 250.0, 350.0, 0.4
# Bones are searched in blocks of voxels of this size, and continued beyond the CT's border as far as this.
COARSE_MM, BEYOND_MM = 1.8, 45.0


def bones(hu: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Cortical bone and marrow.

    Marrow may be no denser than enhanced soft tissue, but is enclosed by cortical bone.
    """
    step = np.maximum(1, np.rint(COARSE_MM / spacing_mm)).astype(int)
    if not (hu > BONE_ABOVE_HU).any():
        return np.zeros(hu.shape, bool)
    # The maximum of each block, as cortical bone may be thinner than a block.
    coarse = block_reduce(hu, tuple(step), np.max, cval=hu.min())
    shell = _large_parts(coarse, float(np.prod(spacing_mm * step)))
    # A bone cut by the CT's border is continued beyond it as its mirror image.
    beyond = [min(n, int(BEYOND_MM / (s * k))) for n, s, k in zip(shell.shape, spacing_mm, step, strict=True)]
    whole = np.pad(shell, [(n, n) for n in beyond], mode="symmetric")
    whole = ndimage.binary_closing(whole, iterations=2)
    filled = np.logical_or.reduce([_filled(whole, axis) for axis in range(3)])
    inner = filled[tuple(slice(n, n + size) for n, size in zip(beyond, shell.shape, strict=True))]
    fine = inner.repeat(step[0], 0).repeat(step[1], 1).repeat(step[2], 2)
    return fine[: hu.shape[0], : hu.shape[1], : hu.shape[2]]


def spine_middle(bone: np.ndarray) -> np.ndarray | None:
    """The index (3,), fractional, of the middle of the spine, the largest bone (nx, ny, nz); None without a
    bone.
    """
    parts, count = ndimage.label(bone)
    if count == 0:
        return None
    return np.argwhere(parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])).mean(axis=0)


def _filled(solid: np.ndarray, axis: int) -> np.ndarray:
    """The mask with the holes of each section across an axis filled."""
    beside = ndimage.generate_binary_structure(3, 1)
    beside[tuple(slice(None) if k != axis else [0, 2] for k in range(3))] = False
    parts, count = ndimage.label(~solid, beside)
    is_open = np.zeros(count + 1, bool)
    for other in {0, 1, 2} - {axis}:
        for edge in (0, -1):
            is_open[parts.take(edge, other)] = True
    is_open[0] = False
    return ~is_open[parts]


def _large_parts(hu: np.ndarray, voxel_mm3: float) -> np.ndarray:
    """The connected parts above SHELL_ABOVE_HU that contain MIN_BONE_ML above BONE_ABOVE_HU."""
    parts, count = ndimage.label(hu > SHELL_ABOVE_HU)
    hard = np.bincount(parts[hu > BONE_ABOVE_HU], minlength=count + 1) * voxel_mm3 / 1000
    is_bone = hard >= MIN_BONE_ML
    is_bone[0] = False
    return is_bone[parts]
