"""The transducer and its image plane as triangles and lines, in the transducer's frame. NumPy only; lengths in mm.

Local axes: x lateral, to the marked side; y elevation; z along the axis. The image plane leaves the face at
z = -size_z / 2 in the direction -z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

BODY, LENS, MARKER = (0.60, 0.65, 0.70), (0.16, 0.18, 0.21), (0.25, 0.77, 1.0)
LENS_MM = 2.5

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]
)


class Solid(NamedTuple):
    """Vertices (n, 3), unit normals (n, 3), colours (n, 3) in [0, 1], vertex indices of the triangles (3 m,)."""

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    indices: np.ndarray


def cuboid(size, centre=(0.0, 0.0, 0.0), colour=BODY) -> Solid:
    """A box with sharp edges: every side has its own four vertices, normals outward."""
    vertices = (_CORNERS * size + centre)[_SIDES]
    normals = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 4, axis=0)
    quad = np.array([0, 1, 2, 0, 2, 3])
    indices = (4 * np.arange(6)[:, None] + quad).reshape(-1)
    return Solid(vertices.reshape(-1, 3), normals, np.tile(colour, (24, 1)), indices.astype(np.int32))


def transducer(size) -> Solid:
    """The housing, its dark acoustic lens (inside of the same cuboid) and a mark on the +x side."""
    x, y, z = (float(each) for each in size)
    lens = min(LENS_MM, z / 4)
    parts = [
        cuboid((x, y, z - lens), (0, 0, lens / 2), BODY),
        cuboid((x, y, lens), (0, 0, (lens - z) / 2), LENS),
        cuboid((0.5, y * 0.3, z * 0.45), (x / 2, 0, lens / 2), MARKER),
    ]
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices, normals, colours = (np.concatenate([part[i] for part in parts]) for i in range(3))
    indices = np.concatenate([part.indices + offset for part, offset in zip(parts, offsets, strict=True)])
    return Solid(vertices, normals, colours, indices.astype(np.int32))


def cuboid_edges(size) -> np.ndarray:
    """End points of the twelve edges, shape (24, 3), a hair outside so that the sides do not swallow them."""
    return (_CORNERS * (np.asarray(size, dtype=np.float64) + 0.15))[_EDGES].reshape(-1, 3)


def image_plane_grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """The plane of unit width and depth: vertices (rows * columns, 3) with x in [-1/2, 1/2] and z in [-1, 0], the rows
    going down from the face, and vertex indices of the triangles (6 (rows - 1)(columns - 1),)."""
    down, across = np.meshgrid(np.linspace(0, -1, rows), np.linspace(-0.5, 0.5, columns), indexing="ij")
    vertices = np.stack([across, np.zeros_like(across), down], axis=-1).reshape(-1, 3)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    return vertices, (first + [0, columns, 1, 1, columns, columns + 1]).astype(np.int32).reshape(-1)


def image_plane_frame(width_mm: float, depth_mm: float) -> np.ndarray:
    """End points of the four sides of the image plane, shape (8, 3), a hair outside so that they are seen whole."""
    x, z = width_mm / 2 + 0.3, -depth_mm - 0.3
    corners = np.array([[-x, 0, 0], [x, 0, 0], [x, 0, z], [-x, 0, z]])
    return corners[[0, 1, 1, 2, 2, 3, 3, 0]]


def sampled(picture: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Grey values in [0, 1] of a picture at the vertices of `image_plane_grid`, shape (rows * columns,)."""
    down = np.linspace(0, picture.shape[0] - 1, rows).round().astype(np.intp)
    across = np.linspace(0, picture.shape[1] - 1, columns).round().astype(np.intp)
    return picture[down[:, None], across].reshape(-1) / 255.0


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """World points (n, 3) of local ones under a rigid pose (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]
