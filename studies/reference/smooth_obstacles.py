"""Rigid obstacles as distances that are smooth enough for Newton's method, and their normals."""

import numpy as np
import trimesh
from scipy.interpolate import NdBSpline
from scipy.ndimage import spline_filter

from scenes.surfaces import signed_distance_from

FAR_MM = 1e3


class RoundedBox:
    """A box about the origin whose edges and corners are rounded inside its full size [mm].

    Args:
        size_mm: lengths along x, y and z, shape (3,).
        edge_mm: radius of the edges.
    """

    def __init__(self, size_mm: np.ndarray, edge_mm: float) -> None:
        self._core = np.asarray(size_mm, float) / 2 - edge_mm
        self._edge = edge_mm

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [mm], shape (n,)."""
        beyond = np.abs(points) - self._core
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return outside + np.minimum(beyond.max(axis=1), 0.0) - self._edge

    def normal(self, points: np.ndarray) -> np.ndarray:
        """Unit gradient of the distance, shape (n, 3)."""
        beyond = np.abs(points) - self._core
        nearest = np.eye(3)[beyond.argmax(axis=1)]
        out = np.where((beyond <= 0).all(axis=1, keepdims=True), nearest, np.maximum(beyond, 0.0))
        return np.where(points < 0, -1.0, 1.0) * out / np.linalg.norm(out, axis=1, keepdims=True)


class DistanceField:
    """A closed surface as a tricubic B-spline of its signed distance, sampled on a grid.

    Args:
        surface: closed, normals outward, vertices [mm].
        grid_mm: spacing of the samples.
        margin_mm: margin of the field around the surface's bounds.
    """

    def __init__(self, surface: trimesh.Trimesh, grid_mm: float = 1.0, margin_mm: float = 4.0) -> None:
        low, high = surface.bounds
        origin = low - margin_mm
        count = np.ceil((high - low + 2 * margin_mm) / grid_mm).astype(int) + 1
        nodes = origin + grid_mm * np.indices(count).reshape(3, -1).T
        coefficients = spline_filter(
            signed_distance_from(surface, nodes).reshape(count), order=3, mode="mirror"
        )
        # Basis function j is centred at sample j, so the first of its five knots is at j - 2.
        knots = [start + grid_mm * np.arange(-2, n + 2) for start, n in zip(origin, count, strict=True)]
        self._spline = NdBSpline(tuple(knots), coefficients, 3, extrapolate=False)

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [mm], shape (n,); FAR_MM outside the field."""
        gap = self._spline(points)
        return np.where(np.isnan(gap), FAR_MM, gap)

    def normal(self, points: np.ndarray) -> np.ndarray:
        """Unit gradient of the distance, shape (n, 3); nan outside the field."""
        gradient = np.stack([self._spline(points, nu=axis) for axis in np.eye(3, dtype=int)], axis=1)
        return gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
