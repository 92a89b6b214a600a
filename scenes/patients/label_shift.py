"""Whether labels fit their CT better elsewhere: a rigid shift of some millimetres, as from a wrong origin or
slice.

The outline of an organ is compared with the edges of the CT by normalised gradient fields (Haber and
Modersitzki 2006), at all shifts of a lattice.
"""

from dataclasses import replace

import numpy as np
import SimpleITK as sitk
from scipy import ndimage

from scenes.patients.patient_directions import components
from scenes.volumes.voxel_grid import VoxelGrid

LATTICE_MM, STEPS = 2.0, 5  # a best fit at the border is none: shifts of up to 8 mm are found
SMOOTHING = 1.0  # SD in steps
FAT_HU = -100.0
# Share of the contrast of organ to fat: where the HU change by it in one step, an edge counts by 0.7.
WEAK_EDGE = 0.1
# Readers, and the halves of a voxel that labels are rounded to, differ by less.
LEAST_MM, LEAST_VOXELS = 2.5, 0.5
# Agreement is 1 where all of the outline is on an edge of the organ in the CT, and 0 by chance.
LEAST_AGREEMENT, LEAST_GAIN = 0.3, 1.05


def shift_warnings(
    grid: VoxelGrid, hounsfield: np.ndarray, label: VoxelGrid, organ: np.ndarray
) -> tuple[str, ...]:
    """A warning where an organ's outline fits the CT better after a shift.

    ``hounsfield`` (z, y, x) is the CT on ``grid``; the organ (z, y, x) is a mask on the grid ``label``.
    """
    shift = best_shift(grid, hounsfield, label, organ)
    length = float(np.linalg.norm(shift))
    half_voxel = LEAST_VOXELS * float(np.abs(shift @ grid.direction) @ grid.spacing) / max(length, 1e-9)
    if length < max(LEAST_MM, half_voxel):
        return ()
    ways = [f"{mm:.0f} mm {words}" for mm, words in components(shift)]
    return (
        f"the labels fit the CT better when moved by {' and '.join(ways)}; they may be shifted, or of "
        "another series; compare the "
        "outlines in check.png, and export CT and labels again",
    )


def best_shift(grid: VoxelGrid, hounsfield: np.ndarray, label: VoxelGrid, organ: np.ndarray) -> np.ndarray:
    """The shift (3,) LPS [mm] of an organ with the best fit to the CT; zero where none is clearly better
    than none.
    """
    lattice = _lattice(grid, label)
    tissue = lattice.sampled(grid.image(hounsfield), sitk.sitkLinear, FAT_HU).astype(np.float32)
    shape = lattice.sampled(label.image(organ.astype(np.float32)), sitk.sitkLinear, 0.0)
    outline = _gradient(shape)
    edges = _edges(tissue, shape > 0.5)
    fit = _correlation(edges, outline) / np.linalg.norm(outline, axis=0).sum()
    best = np.array(np.unravel_index(np.argmax(fit), fit.shape))
    at_border = (best % (2 * STEPS) == 0).any()
    if at_border or fit.max() < max(LEAST_AGREEMENT, LEAST_GAIN * fit[STEPS, STEPS, STEPS]):
        return np.zeros(3)
    return lattice.direction @ (_peak(fit, best) - STEPS)[::-1] * LATTICE_MM


def _lattice(grid: VoxelGrid, label: VoxelGrid) -> VoxelGrid:
    """A grid of LATTICE_MM along the CT's axes, in the CT, around the label."""
    indices = grid.index(label.corners())
    reach = (STEPS + 1) * LATTICE_MM / grid.spacing
    last = np.array(grid.size) - 1
    low, high = np.clip([indices.min(axis=0) - reach, indices.max(axis=0) + reach], 0, last)
    size = np.maximum((high - low) * grid.spacing // LATTICE_MM, 1).astype(int) + 1
    return replace(grid, size=tuple(size.tolist()), spacing=np.full(3, LATTICE_MM), origin=grid.place(low))


def _gradient(values: np.ndarray) -> np.ndarray:
    """Gradient (3, z, y, x), along the same axes, of what is smoothed; per step."""
    return np.stack(np.gradient(ndimage.gaussian_filter(values, SMOOTHING)))


def _edges(tissue: np.ndarray, organ: np.ndarray) -> np.ndarray:
    """Gradients (3, z, y, x) of the CT, of length 1 at clear edges.

    HU are clipped to those of fat and organ: what is brighter than the organ, such as bone, has no edge to
    it.
    """
    level = float(np.median(tissue[organ])) if organ.any() else 0.0
    gradient = _gradient(np.clip((tissue - FAT_HU) / max(level - FAT_HU, 1.0), 0.0, 1.0))
    return gradient / np.sqrt((gradient**2).sum(axis=0) + WEAK_EDGE**2)


def _correlation(edges: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Sums of the products of two vector fields (3, z, y, x), the second shifted by -STEPS to STEPS along
    each axis.
    """
    # Zeros beyond the lattice: no shift brings in the other end.
    size = [n + STEPS for n in outline.shape[1:]]
    one, two = (np.fft.rfftn(field, size, axes=(1, 2, 3)) for field in (edges, outline))
    sums = np.fft.irfftn((one * two.conj()).sum(axis=0), size, axes=(0, 1, 2))
    return sums[np.ix_(*[np.arange(-STEPS, STEPS + 1)] * 3)]


def _peak(fit: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Where the parabolas through an inner maximum and its neighbours are highest, as an index with
    fractions.
    """
    peak = best.astype(float)
    for axis in range(3):
        below, at, above = fit[(*best[:axis], slice(best[axis] - 1, best[axis] + 2), *best[axis + 1 :])]
        peak[axis] += 0.5 * (below - above) / min(below - 2 * at + above, -1e-9)
    return peak
