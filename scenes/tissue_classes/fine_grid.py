"""A finer grid for CTs with thick slices: HU interpolated linearly, labels by their distances (Raya & Udupa
1990, IEEE Trans Med Imaging 9, 32).

Without it, the border of an organ in slices of 5 mm is a stair, and each of its steps an interface of its own
in the B-mode image.
"""

import numpy as np
import SimpleITK as sitk
import trimesh
from scipy import ndimage
from skimage.measure import block_reduce

from scenes.surfaces import distances_on_grid

# Voxels are divided until they are no longer than this.
LONGEST_MM = 1.7
# Distances from the organ's surface are computed at this spacing, and interpolated.
SURFACE_MM = 3.0
# In the kidney each is exact, and so far from it; farther away the next are interpolated too.
EXACT_MM = (-np.inf, 18.0)
# Distances within large bodies are computed in cells of this size.
CELL_MM = 2.0
FAR_MM = 1e4
Box = tuple[slice, ...]


def fine_factors(spacing_mm: np.ndarray) -> np.ndarray:
    """The number of voxels into which each is divided along each axis (3,)."""
    return np.maximum(np.ceil(np.asarray(spacing_mm) / LONGEST_MM - 1e-6), 1).astype(int)


def fine_index_from_mm(index_from_mm: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """The transform (4, 4) from mm to the indices of the finer grid, whose first voxel begins where the CT's
    first does.
    """
    scale = np.diag([*factors.astype(float), 1.0])
    scale[:3, 3] = (factors - 1) / 2
    return scale @ index_from_mm


def refined(values: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Values (nx, ny, nz) float32 on the finer grid, linear between the voxels' centres."""
    fine = np.asarray(values, np.float32)
    for axis, factor in enumerate(factors):
        if factor > 1:
            count = fine.shape[axis]
            at = np.clip((np.arange(count * factor) + 0.5) / factor - 0.5, 0, count - 1)
            low = np.minimum(at.astype(int), max(count - 2, 0))
            share = (at - low).astype(np.float32).reshape([-1 if k == axis else 1 for k in range(3)])
            high = np.minimum(low + 1, count - 1)
            fine = fine.take(low, axis) * (1 - share) + fine.take(high, axis) * share
    return fine


def refined_labels(labels: np.ndarray, factors: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Labels on the finer grid: of each voxel the label that it is deepest in, 0 where it is in none."""
    if (factors == 1).all():
        return labels
    fine = np.zeros(np.array(labels.shape) * factors, labels.dtype)
    depth = np.zeros(fine.shape, np.float32)
    for code in np.unique(labels[labels > 0]):
        box = box_around(labels == code, 2)
        part = labels[box] == code
        distance = signed_distance_of(part, spacing_mm)
        own = tuple(slice(a.start * f, a.stop * f) for a, f in zip(box, factors, strict=True))
        inside = -refined(distance, factors)
        deeper = inside > depth[own]
        fine[own][deeper] = code
        depth[own][deeper] = inside[deeper]
    return fine


def signed_distance_of(mask: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Distances [mm] (nx, ny, nz) from the voxels of a mask less those from the voxels outside; negative
    inside.

    Linear between neighbours, it is 0 halfway between a voxel inside and one outside, however long voxels are
    along an axis.
    """
    outside = ndimage.distance_transform_edt(~mask, sampling=spacing_mm)
    return (outside - ndimage.distance_transform_edt(mask, sampling=spacing_mm)).astype(np.float32)


def coarse_distance(mask: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Distances [mm] (nx, ny, nz) of the voxels of a mask from those outside it, computed in cells of about
    CELL_MM, and interpolated.

    A cell belongs to the mask if half of its voxels do.
    """
    step = cell_voxels(spacing_mm)
    whole = np.pad(mask, [(0, -n % k) for n, k in zip(mask.shape, step, strict=True)], mode="edge")
    cells = block_reduce(whole, tuple(step), np.mean) >= 0.5
    distance = refined(ndimage.distance_transform_edt(cells, sampling=spacing_mm * step), step)
    return distance[tuple(slice(n) for n in mask.shape)]


def cell_voxels(spacing_mm: np.ndarray, cell_mm: float = CELL_MM) -> np.ndarray:
    """How many voxels (3,) a cell of about ``cell_mm`` has along each axis."""
    return np.maximum(np.rint(cell_mm / spacing_mm), 1).astype(int)


def repeated(coarse: np.ndarray, step: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The values of cells of so many voxels (3,) at the voxels of a grid."""
    fine = coarse.repeat(step[0], 0).repeat(step[1], 1).repeat(step[2], 2)
    return fine[: shape[0], : shape[1], : shape[2]]


def box_around(mask: np.ndarray, voxels: int) -> Box:
    """The box around a mask that is not empty, some voxels wider, within its grid."""
    box = ndimage.find_objects(mask.astype(np.uint8))[0]
    return tuple(
        slice(max(a.start - voxels, 0), min(a.stop + voxels, n)) for a, n in zip(box, mask.shape, strict=True)
    )


def surface_box(
    surface: trimesh.Trimesh, index_from_mm: np.ndarray, shape: tuple[int, ...], margin_mm: float
) -> Box:
    """The voxels of a grid around a surface, with a margin."""
    corners = trimesh.bounds.corners(surface.bounds + [[-margin_mm], [margin_mm]])
    at = corners @ index_from_mm[:3, :3].T + index_from_mm[:3, 3]
    low = np.clip(np.floor(at.min(axis=0)), 0, np.array(shape) - 1).astype(int)
    high = np.clip(np.ceil(at.max(axis=0)) + 1, 1, shape).astype(int)
    return tuple(slice(a, b) for a, b in zip(low, high, strict=True))


class SurfaceGrid:
    """Points SURFACE_MM apart around a closed surface, at which ``distance`` [mm] from it is known, negative
    inside.

    ``at_voxels`` interpolates values at them for a box of another grid.
    """

    def __init__(self, surface: trimesh.Trimesh, margin_mm: float) -> None:
        self.low = surface.bounds[0] - margin_mm
        counts = np.ceil((np.ptp(surface.bounds, axis=0) + 2 * margin_mm) / SURFACE_MM).astype(int) + 1
        self.distance = distances_on_grid(surface, self.low, tuple(counts), SURFACE_MM, EXACT_MM)

    def at_voxels(self, values: np.ndarray, box: Box, index_from_mm: np.ndarray) -> np.ndarray:
        """Values of this grid at the voxels of a box, float32, linear between points; of the nearest point
        outside the grid.
        """
        mm_from_index = np.linalg.inv(index_from_mm)
        first = mm_from_index[:3, :3] @ [a.start for a in box] + mm_from_index[:3, 3]
        # In indices of both grids, whose spacing is 1 for SimpleITK.
        to_grid = sitk.AffineTransform(
            (mm_from_index[:3, :3] / SURFACE_MM).ravel().tolist(), ((first - self.low) / SURFACE_MM).tolist()
        )
        resampler = sitk.ResampleImageFilter()
        resampler.SetSize([int(a.stop - a.start) for a in box])
        resampler.SetTransform(to_grid)
        resampler.SetInterpolator(sitk.sitkLinear)
        resampler.SetUseNearestNeighborExtrapolator(True)
        image = sitk.GetImageFromArray(np.ascontiguousarray(values.T, np.float32))
        return np.ascontiguousarray(sitk.GetArrayFromImage(resampler.Execute(image)).T)
