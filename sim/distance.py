"""Signed distance of points to a closed surface (NumPy, at build time)."""

import igl
import numpy as np
from scipy.ndimage import label

# Every so manieth point of a grid of distances is computed everywhere, the others as near to the surface as this [mm].
COARSENESS, EXACT_MM = 3, 5.0


def signed_distance(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) [mm] of points (n, 3), negative inside, and the nearest faces (n,) of a closed surface.

    Nearest triangles and winding numbers are found apart: together, with pseudonormals, takes libigl four times as
    long.
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
    """Signed distances (nx, ny, nz) [mm] of a closed surface on a regular grid that reaches around it, and its origin.

    They are exact near the surface, where points touch it; farther off they are interpolated in a coarser grid, which is off
    by its half at most. Winding numbers, which make light of folds and slivers, are taken near the
    surface; regions that it parts have one sign each.
    """
    vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    low = vertices.min(axis=0) - reach_mm
    shape = np.ceil((vertices.max(axis=0) + reach_mm - low) / spacing_mm).astype(int) + 1
    distance = _coarsely(vertices, faces, low, shape, spacing_mm)
    exact = np.flatnonzero(distance < EXACT_MM)
    points = low + spacing_mm * np.stack(np.unravel_index(exact, shape), axis=1)
    distance[exact] = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])
    # Of neighbours farther from the surface than they are from each other, both are on one side of it.
    near = distance <= spacing_mm
    region = label(~near.reshape(shape))[0].ravel()
    one_of = np.unique(region, return_index=True)[1]
    asked = np.concatenate([one_of, np.flatnonzero(near)])
    points = low + spacing_mm * np.stack(np.unravel_index(asked, shape), axis=1)
    inside = igl.fast_winding_number(vertices, faces, points) > 0.5
    sign = np.where(inside[: len(one_of)], -1.0, 1.0)[region]
    sign[near] = np.where(inside[len(one_of) :], -1.0, 1.0)
    return (sign * distance).reshape(shape), low


def _coarsely(
    vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, shape: np.ndarray, spacing_mm: float
) -> np.ndarray:
    """Distances (n,) [mm] of a grid's points, linear between those of every so manieth along each axis."""
    coarse = -(-(shape - 1) // COARSENESS) + 1
    points = low + COARSENESS * spacing_mm * np.indices(tuple(coarse)).reshape(3, -1).T
    known = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0]).reshape(coarse)
    for axis, count in enumerate(shape):
        at = np.arange(count) / COARSENESS
        first = np.minimum(at.astype(int), coarse[axis] - 2)
        share = (at - first).reshape([-1 if k == axis else 1 for k in range(3)])
        known = (1 - share) * known.take(first, axis) + share * known.take(first + 1, axis)
    return known.ravel()
