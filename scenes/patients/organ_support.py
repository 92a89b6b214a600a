"""What the organ rests on: a mould of its underside, a bed made from the labels around it, or a surface file
of the user.

The mould is the paper's: Camara et al. 2016 laid the kidney phantom in plasticine; the virtual bead
experiments describe it as the lower 35 % of the organ's height, dilated by 0.3 mm and swept upwards, taken
out of a block; its rim is filleted. The bed is the labelled tissue under the organ and the fat between,
carved in the same manner.
"""

from pathlib import Path

import igl
import numpy as np
import trimesh
from scipy import ndimage
from skimage.measure import marching_cubes

from errors import PatientError
from scenes.patients.label_surfaces import FACES, decimate
from scenes.patients.readers.label_maps import LabelMap, among, resample_nearest
from scenes.surfaces import distances_on_grid, in_lps, load_surface, signed_distance_from, stated_space
from scenes.volumes.voxel_grid import VoxelGrid

# Spacing of the sampling grid.
GRID_MM = 1.0
CLEARANCE_MM = 0.3
# Least share of the clearance anywhere.
LEAST_CLEARANCE = 0.25
ATTEMPTS = 4

# The mould: share of the organ's height, along gravity, inside it; least width of the block around it;
# thickness under the organ's lowest point; radius of the mould's rim and of the block's edges.
DEPTH, BLOCK_WALL_MM, FLOOR_MM, RIM_MM = 0.35, 12.0, 8.0, 4.0

# Labelled tissue within this distance under the organ supports it; the fat between them becomes part of the
# bed.
REACH_MM = 40.0
# The bed's margin around the organ, its height as a share of the organ's height, and the radius of its edges.
WALL_MM, HEIGHT, FILLET_MM = 20.0, 0.5, 3.0
# Removes the steps of the voxels.
SMOOTHING_VOXELS = 1.5
LEAST_UNDER = 0.5
LEAST_ML = 2.0
# A support may touch the organ at rest, but not compress it.
MOST_OVERLAP_MM = 0.5

# Vertical rays through the organ, apart by this.
RAYS_MM = 4.0
# At the start the organ falls until about this share of its projected area lies on the support: on a flat one
# that touches it, real kidneys of the development data fall by up to 2.7 mm. After 5 mm the organ arrives
# with 0.3 m/s, and hangs on its pedicle.
LANDS_ON, MOST_FALL_MM = 0.05, 5.0
# The share of the organ's projected area that a support may have above it: the probe comes from there.
MOST_COVERED = 0.1


def mould(
    organ: trimesh.Trimesh, gravity_direction: np.ndarray, clearance_mm: float = CLEARANCE_MM
) -> trimesh.Trimesh:
    """A rigid block with a mould of the organ's underside, which the organ at rest does not touch: a
    watertight mesh of one body, normals outward, in the organ's frame [mm].

    ``organ`` is a watertight surface at rest, normals outward, vertices (n, 3) [mm]; ``gravity_direction``
    (3,) has any length but zero. ``clearance_mm`` is the gap between organ and mould; the least gap is at
    least a quarter of it. Raises ValueError where gravity has no direction, the organ is not watertight, or
    no shape with the clearance is found.
    """
    frame = _gravity_frame(np.asarray(gravity_direction, float))
    if not organ.is_watertight:
        raise ValueError("the organ's surface is not watertight: a support cannot be moulded on it")
    upright = _turned(organ, frame)
    low, high = upright.bounds
    top = low[2] + DEPTH * (high[2] - low[2])
    lying = upright.vertices[upright.vertices[:, 2] <= top].view(np.ndarray)
    low = np.append(lying.min(axis=0)[:2] - BLOCK_WALL_MM, low[2] - FLOOR_MM)
    high = np.append(lying.max(axis=0)[:2] + BLOCK_WALL_MM, top)
    grid = _grid_over(low, high)
    x, y, z = np.meshgrid(*grid, indexing="ij", sparse=True)
    sides = _rounded_intersection(
        np.maximum(low[0] - x, x - high[0]), np.maximum(low[1] - y, y - high[1]), RIM_MM
    )
    block = _rounded_intersection(np.maximum(sides, low[2] - z), z - high[2], 0.25 * RIM_MM)
    support = _carved(block, _distance_to_swept(upright, grid), upright, grid, RIM_MM, clearance_mm)
    return _turned(support, frame.T)


def bed_of_labels(
    organ: trimesh.Trimesh, labels: LabelMap, own: list[int], gravity: np.ndarray
) -> trimesh.Trimesh:
    """The labelled tissue under an organ and the fat between, carved so that the organ can be lifted out.

    ``organ`` is a watertight surface [mm], LPS; ``labels`` are those around it, with the values ``own`` of
    the organ and of tissue that is not solid; ``gravity`` (3,) is a direction. Raises PatientError where less
    than half of the organ has labelled tissue under it.
    """
    frame = _gravity_frame(np.asarray(gravity, float))
    upright = _turned(organ, frame)
    low, high = upright.bounds
    top = low[2] + HEIGHT * (high[2] - low[2])
    grid = _grid_over(low - [WALL_MM, WALL_MM, REACH_MM], np.append(high[:2] + WALL_MM, top))
    gap = _distance_to_swept(upright, grid)

    size = len(grid[0]), len(grid[1]), len(grid[2])
    start = np.array([axis[0] for axis in grid])
    onto = VoxelGrid(size, np.full(3, GRID_MM), frame.T @ start, frame.T)
    solid = ~among(labels.values, [0, *own])
    tissue = resample_nearest(labels.grid, solid, onto).transpose(2, 1, 0)

    swept = gap < 0
    beneath = ~swept & swept.any(axis=2, keepdims=True)
    # From the bottom up: nodes with tissue at or under them, so with the fat between tissue and organ.
    under = beneath & np.logical_or.accumulate(tissue & beneath, axis=2)
    share = np.count_nonzero(under.any(axis=2)) / np.count_nonzero(swept.any(axis=2))
    if share < LEAST_UNDER:
        raise PatientError(
            f"labelled tissue supports {share:.0%} of the organ: expected {LEAST_UNDER:.0%} or more for a "
            "bed; label more of "
            "the tissue under it, or leave --support out for a mould"
        )
    bed = (tissue & (gap > 0)) | under
    signed = ndimage.distance_transform_edt(~bed) - ndimage.distance_transform_edt(bed)
    level = GRID_MM * ndimage.gaussian_filter(signed, SMOOTHING_VOXELS)
    level = _rounded_intersection(level, np.broadcast_to(grid[2] - top, gap.shape), FILLET_MM)
    try:
        return _turned(_carved(level, gap, upright, grid, FILLET_MM, CLEARANCE_MM), frame.T)
    except ValueError as error:
        raise PatientError(f"no bed of labels fits: {error}; leave --support out for a mould") from error


def bed_of_file(path: Path, organ: trimesh.Trimesh, gravity: np.ndarray) -> trimesh.Trimesh:
    """A support from an STL, PLY or OBJ file [mm], LPS unless it states RAS.

    ``organ`` is a watertight surface [mm], LPS; ``gravity`` (3,) is a direction. Raises PatientError where
    the file's surface is not closed, overlaps the organ, is far from it, or is not under it.
    """
    if not path.is_file():
        raise PatientError(
            f"{path}: no such file; give a surface for --support: mould, labels, or an STL, PLY or OBJ file"
        )
    bed = in_lps(load_surface(path), stated_space(path))
    expected = "in mm and in the CT's coordinates (LPS)"
    gap = least_gap(bed, organ)
    if gap < -MOST_OVERLAP_MM:
        raise PatientError(
            f"{path}: reaches {-gap:.1f} mm into the organ; expected a support beside it, {expected}"
        )
    apart = np.maximum(bed.bounds[0] - organ.bounds[1], organ.bounds[0] - bed.bounds[1]).max()
    if apart > REACH_MM:
        raise PatientError(
            f"{path}: is {apart:.0f} mm from the organ; expected a support under it, {expected}"
        )
    _check_under(path, bed, organ, gravity)
    return trimesh.Trimesh(bed.vertices, bed.faces, process=False)


def _check_under(path: Path, bed: trimesh.Trimesh, organ: trimesh.Trimesh, gravity: np.ndarray) -> None:
    """Raises PatientError where a bed is not close under an organ along gravity, or covers it."""
    gaps, covered = vertical_gaps(bed, organ, gravity)
    share, above = float(np.mean(gaps <= REACH_MM)), float(covered.mean())
    x, y, z = gravity
    along = f"along gravity, which is ({x:g}, {y:g}, {z:g}) in LPS"
    if share < LEAST_UNDER:
        raise PatientError(
            f"{path}: is under {share:.0%} of the organ and above {above:.0%} of it, {along}; expected under "
            f"{LEAST_UNDER:.0%} or "
            "more; move it under the organ, or leave --support out for a mould"
        )
    if above > MOST_COVERED:
        raise PatientError(
            f"{path}: covers {above:.0%} of the organ from above, {along}; expected at most "
            f"{MOST_COVERED:.0%}, as the probe comes "
            "from there; cut off what is above the organ"
        )
    fall = float(np.sort(gaps)[int(LANDS_ON * len(gaps))])
    if fall > MOST_FALL_MM:
        raise PatientError(
            f"{path}: is {fall:.1f} mm under the organ, {along}, so that the organ would fall on it; "
            "expected at most "
            f"{MOST_FALL_MM:g} mm; move it closer, fill the space between, or leave --support out for a mould"
        )


def vertical_gaps(
    bed: trimesh.Trimesh, organ: trimesh.Trimesh, gravity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of vertical rays through an organ: the gap [mm] from its underside to the bed, inf where there is none;
    and where the bed is above it.

    Both have the shape (ray_count,); the rays are evenly spaced over the organ's projected area.
    """
    frame = _gravity_frame(np.asarray(gravity, float))
    upright, under = _turned(organ, frame), _turned(bed, frame)
    low, high = upright.bounds
    bottom = min(low[2], under.bounds[0, 2]) - 1.0
    # A fraction of the spacing that meets no vertices of a regular surface.
    start, end = low + 0.37 * RAYS_MM, high
    gaps, covered = [], []
    for x in np.arange(start[0], end[0], RAYS_MM):
        for y in np.arange(start[1], end[1], RAYS_MM):
            own = _heights(upright, x, y, bottom)
            if len(own) == 0:
                continue
            middle = 0.5 * (own.min() + own.max())
            beds = _heights(under, x, y, bottom)
            gaps.append(max(0.0, own.min() - max(beds[beds <= middle], default=-np.inf)))
            covered.append(bool((beds > middle).any()))
    return np.array(gaps), np.array(covered)


def _heights(surface: trimesh.Trimesh, x: float, y: float, bottom: float) -> np.ndarray:
    """Heights at which a vertical ray from under a surface meets it."""
    hits = igl.ray_mesh_intersect(
        np.array([x, y, bottom]),
        np.array([0.0, 0.0, 1.0]),
        np.ascontiguousarray(surface.vertices, float),
        np.ascontiguousarray(surface.faces, np.int64),
    )
    return bottom + np.array([hit[1] for hit in hits])


def least_gap(support: trimesh.Trimesh, organ: trimesh.Trimesh) -> float:
    """Least signed distance [mm] between closed surfaces, at the vertices of both; negative: overlap."""
    return float(
        min(
            signed_distance_from(organ, support.vertices).min(),
            signed_distance_from(support, organ.vertices).min(),
        )
    )


def _gravity_frame(gravity: np.ndarray) -> np.ndarray:
    """Rotation matrix whose rows are two horizontal axes and the upward axis; patient axes where possible."""
    length = np.linalg.norm(gravity)
    if gravity.shape != (3,) or not np.isfinite(length) or length == 0:
        raise ValueError(f"gravity_direction is {gravity}: expected three numbers, not all zero")
    up = -gravity / length
    level = np.eye(3)[np.argmin(np.abs(up))]
    level = level - (level @ up) * up
    level /= np.linalg.norm(level)
    return np.array([level, np.cross(up, level), up])


def _turned(surface: trimesh.Trimesh, frame: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.view(np.ndarray) @ frame.T, surface.faces, process=False)


def _grid_over(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
    """Axes of a grid around a block with one empty cell on each side; the block's faces are between nodes."""
    return tuple(
        np.arange(start - 1.5 * GRID_MM, end + 2.0 * GRID_MM, GRID_MM)
        for start, end in zip(low, high, strict=True)
    )


def _distance_to_swept(surface: trimesh.Trimesh, grid: tuple[np.ndarray, ...]) -> np.ndarray:
    """Distance [mm] from the grid's nodes to the organ swept upwards to infinity; negative inside.

    The distance to a union is the minimum of the distances to its parts, and a copy of the organ raised by t
    is as far from a point as the organ is from the point t lower: a running minimum along the upward axis.
    """
    low, counts = np.array([axis[0] for axis in grid]), tuple(len(axis) for axis in grid)
    return np.minimum.accumulate(distances_on_grid(surface, low, counts, GRID_MM), axis=2)


def _rounded_intersection(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Intersection of two solids given by signed distances, their common edge rounded to `radius`."""
    corner = np.hypot(np.maximum(a + radius, 0.0), np.maximum(b + radius, 0.0)) - radius
    return np.minimum(np.maximum(a, b), -radius) + np.maximum(corner + radius, 0.0)


def _carved(
    solid: np.ndarray,
    gap: np.ndarray,
    organ: trimesh.Trimesh,
    grid: tuple[np.ndarray, ...],
    fillet_mm: float,
    clearance_mm: float,
) -> trimesh.Trimesh:
    """A solid (signed distance) less the swept organ, with a clearance to the organ at rest. Raises
    ValueError.

    Decimation moves the support towards the organ; the gap is increased until the clearance is met.
    """
    gap_mm = clearance_mm
    for _ in range(ATTEMPTS):
        support = _contour(_rounded_intersection(solid, gap_mm - gap, fillet_mm), grid)
        least = least_gap(support, organ)
        if least >= LEAST_CLEARANCE * clearance_mm:
            return support
        gap_mm += clearance_mm - least
    raise ValueError(
        f"the support has a clearance of {least:.2f} mm to the organ; expected {clearance_mm} mm"
    )


def _contour(level: np.ndarray, grid: tuple[np.ndarray, ...]) -> trimesh.Trimesh:
    """Zero level on the grid, of about FACES triangles, normals outward: a solid that ends within its grid,
    without cavities and specks.
    """
    bounded = np.pad(level[1:-1, 1:-1, 1:-1], 1, constant_values=GRID_MM)
    parts, _ = ndimage.label(bounded < 0)
    large = np.bincount(parts.ravel()) * GRID_MM**3 / 1000 >= LEAST_ML
    large[0] = False
    solid = ndimage.binary_fill_holes(large[parts])
    clear = 1e-3 * GRID_MM  # a level of exactly zero at a node gives triangles of no area
    bounded = np.where(solid, np.minimum(bounded, -clear), np.maximum(bounded, clear))
    vertices, triangles, _, _ = marching_cubes(bounded, 0.0, spacing=(grid[0][1] - grid[0][0],) * 3)
    fine = trimesh.Trimesh(vertices + [axis[0] for axis in grid], triangles, process=False)
    if fine.volume < 0:
        fine.invert()
    return decimate(fine, FACES)
