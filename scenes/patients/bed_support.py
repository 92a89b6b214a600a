"""Supports other than the mould: a bed made from the labels around the organ, or a surface file of the user."""

from pathlib import Path

import numpy as np
import trimesh
from scipy import ndimage

from errors import PatientError
from scenes.patients.moulded_support import (
    CLEARANCE_MM,
    GRID_MM,
    contour,
    distance_to_swept,
    gravity_frame,
    grid_over,
    least_gap,
    rounded_intersection,
    with_clearance,
)
from scenes.patients.readers.label_maps import LabelMap, resample_nearest
from scenes.surfaces import load_surface
from scenes.volumes.voxel_grid import VoxelGrid

# Labelled tissue within this distance under the organ supports it; the fat between them becomes part of the bed.
REACH_MM = 40.0
# The bed's margin around the organ, and its height as a share of the organ's height.
WALL_MM, HEIGHT = 20.0, 0.5
FILLET_MM = 3.0
# Removes the steps of the voxels.
SMOOTHING_VOXELS = 1.5
LEAST_UNDER = 0.5
LEAST_ML = 2.0
# A support may touch the organ at rest, but not compress it.
MOST_OVERLAP_MM = 0.5


def bed_of_labels(
    organ: trimesh.Trimesh, labels: LabelMap, own: list[int], gravity: np.ndarray
) -> trimesh.Trimesh:
    """The labelled tissue under an organ and the fat between, carved so that the organ can be lifted out.

    Args:
        organ: watertight surface [mm], LPS.
        labels: the labels around it.
        own: label values of the organ, and of tissue that is not solid.
        gravity: its direction, shape (3,).

    Raises:
        PatientError: less than half of the organ has labelled tissue under it.
    """
    frame = gravity_frame(np.asarray(gravity, float))
    upright = organ.vertices.view(np.ndarray) @ frame.T
    faces = organ.faces.view(np.ndarray).astype(np.int64)
    low, high = upright.min(axis=0), upright.max(axis=0)
    top = low[2] + HEIGHT * (high[2] - low[2])
    grid = grid_over(low - [WALL_MM, WALL_MM, REACH_MM], np.append(high[:2] + WALL_MM, top), GRID_MM)
    gap = distance_to_swept(upright, faces, grid)
    tissue = _tissue(labels, own, grid, frame)
    under = _with_fat(tissue, gap < 0)
    share = np.count_nonzero(under.any(axis=2)) / np.count_nonzero((gap < 0).any(axis=2))
    if share < LEAST_UNDER:
        raise PatientError(
            f"labelled tissue supports {share:.0%} of the organ: expected {LEAST_UNDER:.0%} or more for a bed; label more of "
            "the tissue under it, or leave --support out for a mould"
        )
    level = _smooth_distance((tissue & (gap > 0)) | under)
    level = rounded_intersection(level, np.broadcast_to(grid[2] - top, gap.shape), radius=FILLET_MM)

    def carved(gap_mm: float) -> trimesh.Trimesh:
        return contour(_closed(rounded_intersection(level, gap_mm - gap, radius=FILLET_MM)), grid)

    try:
        bed = with_clearance(upright, faces, carved, CLEARANCE_MM)
    except ValueError as error:
        raise PatientError(f"no bed of labels fits: {error}; leave --support out for a mould") from error
    return trimesh.Trimesh(bed.vertices @ frame, bed.faces, process=False)


def _tissue(labels: LabelMap, own: list[int], grid: tuple[np.ndarray, ...], frame: np.ndarray) -> np.ndarray:
    """Whether the nodes (x, y, z) of an upright grid are in labelled tissue."""
    solid = ~np.isin(labels.values, [0, *own])
    size = len(grid[0]), len(grid[1]), len(grid[2])
    start = np.array([axis[0] for axis in grid])
    onto = VoxelGrid(size, np.full(3, GRID_MM), frame.T @ start, frame.T)
    return resample_nearest(labels.grid, solid, onto).transpose(2, 1, 0)


def _with_fat(tissue: np.ndarray, swept: np.ndarray) -> np.ndarray:
    """The nodes between the organ's underside and the tissue under it, and that tissue."""
    beneath = ~swept & swept.any(axis=2, keepdims=True)
    # From the bottom up: nodes with tissue at or under them.
    return beneath & np.logical_or.accumulate(tissue & beneath, axis=2)


def _smooth_distance(solid: np.ndarray) -> np.ndarray:
    """Smoothed signed distance [mm] to a solid's surface, negative inside."""
    apart = ndimage.distance_transform_edt(~solid) - ndimage.distance_transform_edt(solid)
    return GRID_MM * ndimage.gaussian_filter(apart, SMOOTHING_VOXELS)


def _closed(level: np.ndarray) -> np.ndarray:
    """The level set of a solid that ends within its grid, without cavities and specks."""
    bounded = np.pad(level[1:-1, 1:-1, 1:-1], 1, constant_values=GRID_MM)
    parts, _ = ndimage.label(bounded < 0)
    large = np.bincount(parts.ravel()) * GRID_MM**3 / 1000 >= LEAST_ML
    large[0] = False
    solid = ndimage.binary_fill_holes(large[parts])
    clear = 1e-3 * GRID_MM
    return np.where(solid, np.minimum(bounded, -clear), np.maximum(bounded, clear))


def bed_of_file(path: Path, organ: trimesh.Trimesh) -> trimesh.Trimesh:
    """A support from a file, LPS [mm]. Raises PatientError: not a closed surface, overlaps the organ, or far from it."""
    if not path.is_file():
        raise PatientError(
            f"{path}: no such file; give a surface for --support: mould, labels, or an STL, PLY or OBJ file"
        )
    bed = load_surface(path)
    gap = least_gap(bed.vertices, bed.faces.astype(np.int64), organ.vertices, organ.faces.astype(np.int64))
    if gap < -MOST_OVERLAP_MM:
        raise PatientError(
            f"{path}: reaches {-gap:.1f} mm into the organ; expected a support beside it, in mm and in the CT's coordinates (LPS)"
        )
    apart = np.maximum(bed.bounds[0] - organ.bounds[1], organ.bounds[0] - bed.bounds[1]).max()
    if apart > REACH_MM:
        raise PatientError(
            f"{path}: is {apart:.0f} mm from the organ; expected a support under it, in mm and in the CT's coordinates (LPS)"
        )
    return trimesh.Trimesh(bed.vertices, bed.faces, process=False)
