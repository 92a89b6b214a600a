"""The transducer and its image plane as triangles and lines, in the transducer's frame. NumPy only; lengths in mm.

Local axes: x lateral, to the marked side; y elevation; z along the axis. The image plane leaves the face at
z = -size_z / 2 in the direction -z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.viewer import View

BODY, LENS, MARKER = (0.60, 0.65, 0.70), (0.16, 0.18, 0.21), (0.25, 0.77, 1.0)
LENS_MM = 2.5
FRAME_SIDES = 48
ARC_POINTS = 15

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]
)


class TransducerShape(NamedTuple):
    """Vertices (n, 3), unit normals (n, 3), colours (n, 3) in [0, 1], vertex indices of the triangles (3 m,)."""

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    indices: np.ndarray


def cuboid(size, centre=(0.0, 0.0, 0.0), colour=BODY) -> TransducerShape:
    """A box with sharp edges: every side has its own four vertices, normals outward."""
    vertices = (_CORNERS * size + centre)[_SIDES]
    normals = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 4, axis=0)
    quad = np.array([0, 1, 2, 0, 2, 3])
    indices = (4 * np.arange(6)[:, None] + quad).reshape(-1)
    return TransducerShape(
        vertices.reshape(-1, 3), normals, np.tile(colour, (24, 1)), indices.astype(np.int32)
    )


def prism(profile: np.ndarray, length: float, colour=BODY) -> TransducerShape:
    """A convex profile (n, 2) of x and z, clockwise where x is to the right and z up, drawn out along y, about y = 0."""
    count = len(profile)
    ends = [np.insert(profile, 1, y, axis=1) for y in (-length / 2, length / 2)]
    following = np.roll(np.arange(count), -1)
    sides = np.stack([ends[0], ends[1], ends[1][following], ends[0][following]], axis=1)
    edge = profile[following] - profile
    outward = np.column_stack([-edge[:, 1], np.zeros(count), edge[:, 0]])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    vertices = np.concatenate([sides.reshape(-1, 3), *ends])
    normals = np.concatenate(
        [np.repeat(outward, 4, axis=0), np.tile([0, -1.0, 0], (count, 1)), np.tile([0, 1.0, 0], (count, 1))]
    )
    quads = 4 * np.arange(count)[:, None] + [0, 2, 1, 0, 3, 2]
    fan = np.column_stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)])
    indices = np.concatenate(
        [quads.reshape(-1), (4 * count + fan[:, ::-1]).reshape(-1), (5 * count + fan).reshape(-1)]
    )
    return TransducerShape(vertices, normals, np.tile(colour, (len(vertices), 1)), indices.astype(np.int32))


def transducer(size, radius: float = 0.0) -> TransducerShape:
    """The housing, its dark acoustic lens, flat or an arc of a radius, and a mark on the +x side."""
    x, y, z = (float(each) for each in size)
    lens = min(LENS_MM, z / 4)
    face = _face(x, z, radius)
    top = face[:, 1].max() + lens
    upper = np.array([[x / 2, top], [-x / 2, top]])
    parts = [
        cuboid((x, y, z / 2 - top), (0, 0, z / 4 + top / 2), BODY),
        prism(np.concatenate([face, upper])[::-1], y, LENS),
        cuboid((0.5, y * 0.3, z * 0.45), (x / 2, 0, (z / 2 + top) / 2), MARKER),
    ]
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices, normals, colours = (np.concatenate([part[i] for part in parts]) for i in range(3))
    indices = np.concatenate([part.indices + offset for part, offset in zip(parts, offsets, strict=True)])
    return TransducerShape(vertices, normals, colours, indices.astype(np.int32))


def _face(x: float, z: float, radius: float) -> np.ndarray:
    """The face's profile (n, 2) from -x to +x, lowest in its middle at -z / 2."""
    if radius == 0:
        return np.array([[-x / 2, -z / 2], [x / 2, -z / 2]])
    across = np.linspace(-x / 2, x / 2, ARC_POINTS)
    return np.column_stack([across, radius - np.sqrt(np.maximum(radius**2 - across**2, 0)) - z / 2])


def edges(size, radius: float = 0.0) -> np.ndarray:
    """End points of the housing's straight edges, shape (24, 3), a hair outside so that the sides do not swallow them."""
    x, y, z = (float(each) for each in size)
    foot = _face(x, z, radius)[:, 1].max()
    box = np.array([x, y, z / 2 - foot])
    return (_CORNERS * (box + 0.15) + [0.0, 0.0, (z / 2 + foot) / 2])[_EDGES].reshape(-1, 3)


def image_plane_grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """A raster of the picture: shares (rows * columns, 2) of its lines, left to right, and of their depth, going down from the
    face, and vertex indices of the triangles (6 (rows - 1)(columns - 1),)."""
    down, across = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    shares = np.stack([across, down], axis=-1).reshape(-1, 2)
    return shares, (first + [0, columns, 1, 1, columns, columns + 1]).astype(np.int32).reshape(-1)


def on_plane(shares: np.ndarray, view: View) -> np.ndarray:
    """Places (n, 2) on the image plane [mm] of shares (n, 2) of its lines and their depth: a box, or a sector of a circle."""
    if view.sector is None:
        return (shares - [0.5, 0.0]) * [view.width_mm, view.depth_mm]
    radius, start, stop = view.sector
    angle = start + shares[:, 0] * (stop - start)
    reach = radius + shares[:, 1] * (view.depth_mm - view.above_mm)
    return np.column_stack([reach * np.sin(angle), reach * np.cos(angle) - radius])


def standing(places: np.ndarray) -> np.ndarray:
    """Places (n, 2) of the image plane as points (n, 3) with the face's middle as origin: the plane goes down along -z."""
    return np.column_stack([places[:, 0], np.zeros(len(places)), -places[:, 1]])


def image_plane_frame(view: View) -> np.ndarray:
    """End points of the sides of the image plane, shape (2 FRAME_SIDES, 3), a hair outside so that they are seen whole."""
    quarter = np.linspace(0, 1, FRAME_SIDES // 4, endpoint=False)
    low, high = np.full_like(quarter, -0.008), np.full_like(quarter, 1.008)
    sides = [(quarter, low), (high, quarter), (1 - quarter, high), (low, 1 - quarter)]
    around = standing(on_plane(np.concatenate([np.column_stack(side) for side in sides]), view))
    return np.stack([around, np.roll(around, -1, axis=0)], axis=1).reshape(-1, 3)


def sampled(picture: np.ndarray, places: np.ndarray, view: View) -> np.ndarray:
    """Grey values in [0, 1] of a picture at places (n, 2) of its plane [mm], shape (n,)."""
    share = (places + [view.width_mm / 2, view.above_mm]) / [view.width_mm, view.depth_mm]
    size = np.array(picture.shape[::-1])
    column, row = np.clip(np.floor(share * size), 0, size - 1).astype(np.intp).T
    return picture[row, column] / 255.0


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """World points (n, 3) of local ones under a rigid pose (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]
