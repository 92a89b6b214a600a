"""Rigid obstacles as smooth distances with first and second derivatives, which Newton's method needs."""

import igl
import numpy as np
import trimesh
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
    """A closed surface through a tricubic B-spline of its signed distance, sampled on a grid.

    Args:
        surface: closed, normals outward, vertices [mm].
        grid_mm: spacing of the samples.
        margin_mm: how far around the surface's box the field reaches; beyond it everything is far.
    """

    def __init__(self, surface: trimesh.Trimesh, grid_mm: float = 1.0, margin_mm: float = 4.0) -> None:
        low, high = surface.bounds
        self._origin, self._step = low - margin_mm, grid_mm
        count = np.ceil((high - low + 2 * margin_mm) / grid_mm).astype(int) + 1
        nodes = self._origin + grid_mm * np.indices(count).reshape(3, -1).T
        self._coefficients = spline_filter(
            signed_distance(surface, nodes).reshape(count), order=3, mode="mirror"
        )

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [mm], shape (n,)."""
        return self._evaluated(points, [(0, 0, 0)], FAR_MM)[0]

    def slopes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient, shape (n, 3), and second derivatives [1/mm], shape (n, 3, 3)."""
        axes = np.eye(3, dtype=int)
        orders = [*axes] + [axes[i] + axes[j] for i in range(3) for j in range(3)]
        values = self._evaluated(points, [tuple(order) for order in orders], 0.0)
        return values[:3].T, values[3:].T.reshape(-1, 3, 3)

    def _evaluated(self, points: np.ndarray, orders: list[tuple[int, ...]], elsewhere: float) -> np.ndarray:
        """Derivatives of the spline, each of its orders along x, y and z; shape (orders, n)."""
        values = np.full((len(orders), len(points)), elsewhere)
        place = (points - self._origin) / self._step
        cell = np.floor(place).astype(int)
        inside = ((cell >= 1) & (cell < np.array(self._coefficients.shape) - 2)).all(axis=1)
        cell, place = cell[inside], (place - cell)[inside]
        window = cell[:, :, None] + np.arange(-1, 3)
        near = self._coefficients[
            window[:, 0, :, None, None], window[:, 1, None, :, None], window[:, 2, None, None, :]
        ]
        weights = [_cubic(place, order) / self._step**order for order in range(3)]
        for value, (i, j, k) in zip(values, orders, strict=True):
            along_z = np.einsum("nxyz,nz->nxy", near, weights[k][:, 2])
            value[inside] = np.einsum("nxy,nx,ny->n", along_z, weights[i][:, 0], weights[j][:, 1])
        return values


def signed_distance(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Distance [mm] of points (n, 3) from a closed surface, negative inside; shape (n,)."""
    return igl.signed_distance(
        np.ascontiguousarray(points, float),
        np.ascontiguousarray(surface.vertices, float),
        np.ascontiguousarray(surface.faces, np.int64),
        igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]


def _cubic(t: np.ndarray, order: int) -> np.ndarray:
    """The four uniform cubic B-splines that reach a place t in [0, 1) of a cell, or a derivative of them."""
    if order == 0:
        pieces = [
            (1 - t) ** 3 / 6,
            2 / 3 - t**2 + t**3 / 2,
            2 / 3 - (1 - t) ** 2 + (1 - t) ** 3 / 2,
            t**3 / 6,
        ]
    elif order == 1:
        pieces = [-((1 - t) ** 2) / 2, 1.5 * t**2 - 2 * t, 2 * (1 - t) - 1.5 * (1 - t) ** 2, t**2 / 2]
    else:
        pieces = [1 - t, 3 * t - 2, 1 - 3 * t, t]
    return np.stack(pieces, axis=-1)
