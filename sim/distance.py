"""Signed distance of points to a closed surface (NumPy, at build time)."""

import igl
import numpy as np
from scipy.ndimage import label


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

    Winding numbers, which make light of folds and slivers, are taken near the surface; farther off, regions that it
    parts have one sign each.
    """
    low = vertices.min(axis=0) - reach_mm
    shape = np.ceil((vertices.max(axis=0) + reach_mm - low) / spacing_mm).astype(int) + 1
    points = low + spacing_mm * np.indices(shape).reshape(3, -1).T
    faces = np.ascontiguousarray(faces, np.int64)
    squared = igl.point_mesh_squared_distance(points, np.ascontiguousarray(vertices, np.float64), faces)[0]
    distance = np.sqrt(squared)
    # Of neighbours farther from the surface than they are from each other, both are on one side of it.
    near = distance <= spacing_mm
    region = label(~near.reshape(shape))[0].ravel()
    one_of = np.unique(region, return_index=True)[1]
    asked = np.concatenate([one_of, np.flatnonzero(near)])
    inside = igl.fast_winding_number(np.ascontiguousarray(vertices, np.float64), faces, points[asked]) > 0.5
    sign = np.where(inside[: len(one_of)], -1.0, 1.0)[region]
    sign[near] = np.where(inside[len(one_of) :], -1.0, 1.0)
    return (sign * distance).reshape(shape), low
