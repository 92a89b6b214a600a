"""Signed distances to a closed surface, at build time: of points, and of a regular grid (for which Taichi
must be started).
"""

import igl
import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.ndimage import label

from sim.device import backend
from sim.stored_arrays import stored

# Grid points nearer to the surface than EXACT_MM get exact distances, the others are interpolated from every
# third point.
COARSENESS, EXACT_MM = 3, 5.0
# A little more than half of the spacing.
NEAR_CELLS = 0.51
TINY = 1e-30


def signed_distance(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) [mm] of points (n, 3), negative inside, and the nearest faces (n,) of a closed surface.

    Nearest triangles and winding numbers are two calls: libigl's one call with pseudonormals takes four times
    as long.
    """
    vertices = np.ascontiguousarray(vertices, np.float64)
    faces = np.ascontiguousarray(faces, np.int64)
    points = np.ascontiguousarray(points, np.float64)
    squared, nearest, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    inside = igl.fast_winding_number(vertices, faces, points) > 0.5
    return np.where(inside, -1.0, 1.0) * np.sqrt(squared), nearest


def distance_grid(
    vertices: np.ndarray, faces: np.ndarray, spacing_mm: float, reach_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (nx, ny, nz) [mm] to a closed surface on a grid that extends ``reach_mm`` around it,
    and its origin (3,).

    Exact near the surface; farther away interpolated in a coarser grid, with an error of half its spacing at
    most. The sign is from winding numbers, which are robust to folds and slivers: point by point near the
    surface, one for each region that it separates.
    """
    vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    distance, low = stored(_distances, vertices, faces, float(spacing_mm), float(reach_mm), backend=backend())
    return distance, low


def _distances(
    vertices: np.ndarray, faces: np.ndarray, spacing_mm: float, reach_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """As ``distance_grid``, computed."""
    low = vertices.min(axis=0) - reach_mm
    shape = np.ceil((vertices.max(axis=0) + reach_mm - low) / spacing_mm).astype(int) + 1
    exact = _distances_near(vertices, faces, low, shape, spacing_mm, EXACT_MM)
    coarse = np.maximum(_coarse_distances(vertices, faces, low, shape, spacing_mm), EXACT_MM)
    distance = np.where(exact < EXACT_MM, exact, coarse)
    return (_signs(vertices, faces, low, shape, spacing_mm, distance) * distance).reshape(shape), low


def clipped_distance_grid(
    vertices: np.ndarray,
    faces: np.ndarray,
    low: np.ndarray,
    shape: tuple[int, int, int],
    spacing_mm: float,
    within_mm: float,
) -> np.ndarray:
    """Signed distances (nx, ny, nz) [mm] to a closed surface on a grid with its first point at ``low`` (3,):
    exact to float32 up to ``within_mm``, which is at least the spacing, and beyond it that with the sign.
    """
    vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    size = np.array(shape)
    distance = _distances_near(vertices, faces, low, size, spacing_mm, within_mm)
    return (_signs(vertices, faces, low, size, spacing_mm, distance) * distance).reshape(shape)


def _distances_near(
    vertices: np.ndarray,
    faces: np.ndarray,
    low: np.ndarray,
    shape: np.ndarray,
    spacing_mm: float,
    within_mm: float,
) -> np.ndarray:
    """Distances (n,) [mm] of a grid's points, at most ``within_mm``."""
    squared = np.full(tuple(shape), within_mm**2, np.float32)
    _squares_near(((vertices - low) / spacing_mm).astype(np.float32)[faces], spacing_mm, within_mm, squared)
    return np.sqrt(squared.ravel().astype(np.float64))


def _signs(
    vertices: np.ndarray,
    faces: np.ndarray,
    low: np.ndarray,
    shape: np.ndarray,
    spacing_mm: float,
    distance: np.ndarray,
) -> np.ndarray:
    """-1 (n,) for a grid's points inside a surface, 1 for those outside; ``distance`` (n,) [mm] is how far
    they are from it.
    """
    # Neighbours that are both farther from the surface than half their distance are on the same side of it.
    near = distance <= NEAR_CELLS * spacing_mm
    region = label(~near.reshape(shape))[0].ravel()
    samples = np.unique(region, return_index=True)[1]
    queried = np.concatenate([samples, np.flatnonzero(near)])
    points = low + spacing_mm * np.stack(np.unravel_index(queried, shape), axis=1)
    inside = igl.fast_winding_number(vertices, faces, points) > 0.5
    sign = np.where(inside[: len(samples)], -1.0, 1.0)[region]
    sign[near] = np.where(inside[len(samples) :], -1.0, 1.0)
    return sign


def _coarse_distances(
    vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, shape: np.ndarray, spacing_mm: float
) -> np.ndarray:
    """Distances (n,) [mm] of a grid's points, interpolated linearly between those of every third along
    each axis.
    """
    coarse = -(-(shape - 1) // COARSENESS) + 1
    points = low + COARSENESS * spacing_mm * np.indices(tuple(coarse)).reshape(3, -1).T
    known = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0]).reshape(coarse)
    for axis, count in enumerate(shape):
        at = np.arange(count) / COARSENESS
        first = np.minimum(at.astype(int), coarse[axis] - 2)
        weight = (at - first).reshape([-1 if k == axis else 1 for k in range(3)])
        known = (1 - weight) * known.take(first, axis) + weight * known.take(first + 1, axis)
    return known.ravel()


@ti.kernel
def _squares_near(
    corners: ti.types.ndarray(dtype=ti.math.vec3, ndim=2),
    spacing_mm: ti.f32,
    within_mm: ti.f32,
    squared: ti.types.ndarray(ndim=3),
):
    """Squared distances [mm^2] of a grid's points from triangles with corners (n, 3) [cells], where nearer
    than ``within_mm``.
    """
    for face in range(corners.shape[0]):
        a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
        margin = within_mm / spacing_mm
        last = tm.ivec3(squared.shape[0] - 1, squared.shape[1] - 1, squared.shape[2] - 1)
        low = ti.max(ti.cast(ti.ceil(tm.min(a, b, c) - margin), ti.i32), 0)
        high = ti.min(ti.cast(ti.floor(tm.max(a, b, c) + margin), ti.i32), last)
        for i, j, k in ti.ndrange((low.x, high.x + 1), (low.y, high.y + 1), (low.z, high.z + 1)):
            distance_squared = spacing_mm * spacing_mm * _square_to_triangle(tm.vec3(i, j, k), a, b, c)
            # A minimum does not depend on the order.
            if distance_squared < squared[i, j, k]:
                ti.atomic_min(squared[i, j, k], distance_squared)


@ti.func
def _square_to_triangle(p, a, b, c):
    """Squared distance to the nearest of the three edges, or to the plane where p is above the triangle."""
    normal = tm.cross(b - a, c - a)
    over = _beside(p, a, b, normal) and _beside(p, b, c, normal) and _beside(p, c, a, normal)
    result = ti.min(_square_to_edge(p, a, b), _square_to_edge(p, b, c), _square_to_edge(p, c, a))
    if over:
        result = tm.dot(normal, p - a) ** 2 / tm.dot(normal, normal)
    return result


@ti.func
def _beside(p, a, b, normal):
    return tm.dot(tm.cross(normal, b - a), p - a) > 0.0


@ti.func
def _square_to_edge(p, a, b):
    edge, offset = b - a, p - a
    fraction = tm.clamp(tm.dot(edge, offset) / ti.max(tm.dot(edge, edge), TINY), 0.0, 1.0)
    apart = offset - fraction * edge
    return tm.dot(apart, apart)
