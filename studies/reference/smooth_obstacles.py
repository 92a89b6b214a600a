"""Rigid obstacles as smooth distances with first and second derivatives, which Newton's method needs."""

from itertools import combinations_with_replacement

import igl
import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.interpolate import NdBSpline
from scipy.ndimage import spline_filter

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

    def slopes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient, shape (n, 3), and second derivatives [1/mm], shape (n, 3, 3)."""
        beyond = np.abs(points) - self._core
        within = (beyond <= 0).all(axis=1)
        nearest = np.eye(3)[beyond.argmax(axis=1)]
        out = np.where(within[:, None], nearest, np.maximum(beyond, 0.0))
        length = np.linalg.norm(out, axis=1)[:, None]
        normal = np.where(points < 0, -1.0, 1.0) * out / length
        bend = (np.eye(3) * (out > 0)[:, None, :] - normal[:, :, None] * normal[:, None, :]) / length[
            ..., None
        ]
        bend[within] = 0.0
        return normal, bend


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
        coefficients = spline_filter(signed_distance(surface, nodes).reshape(count), order=3, mode="mirror")
        # Basis function j is centred at sample j, so the first of its five knots is at j - 2.
        knots = [start + grid_mm * np.arange(-2, n + 2) for start, n in zip(origin, count, strict=True)]
        self._spline = NdBSpline(tuple(knots), coefficients, 3, extrapolate=False)

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [mm], shape (n,); FAR_MM outside the field."""
        return self._derivative(points, (0, 0, 0), FAR_MM)

    def slopes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient, shape (n, 3), and second derivatives [1/mm], shape (n, 3, 3)."""
        axes = np.eye(3, dtype=int)
        gradient = np.empty((len(points), 3))
        second = np.empty((len(points), 3, 3))
        for i, j in combinations_with_replacement(range(3), 2):
            second[:, i, j] = second[:, j, i] = self._derivative(points, axes[i] + axes[j], 0.0)
        for i in range(3):
            gradient[:, i] = self._derivative(points, axes[i], 0.0)
        return gradient, second

    def _derivative(self, points: np.ndarray, order: ArrayLike, outside: float) -> np.ndarray:
        values = self._spline(points, nu=order)
        return np.where(np.isnan(values), outside, values)


def signed_distance(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Distance [mm] of points (n, 3) from a closed surface, negative inside; shape (n,)."""
    return igl.signed_distance(
        np.ascontiguousarray(points, float),
        np.ascontiguousarray(surface.vertices, float),
        np.ascontiguousarray(surface.faces, np.int64),
        igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]
