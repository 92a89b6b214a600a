"""The transducer and its image plane as triangles and lines, in the transducer's frame. NumPy only; lengths
in mm.

Local axes: x lateral, to the marked side; y elevation; z along the axis. The image plane leaves the face at
z = -size_z / 2 in the direction -z.
"""

from typing import NamedTuple

import numpy as np
import trimesh

from render.viewer import View

BODY, LENS, MARKER = (0.60, 0.65, 0.70), (0.16, 0.18, 0.21), (0.25, 0.77, 1.0)
LENS_MM = 2.5
FRAME_SIDES = 48
ARC_POINTS = 15

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]
)


class TransducerShape(NamedTuple):
    """Vertices of triangles, three for each, unit normals, and colours in [0, 1], (3 m, 3) each."""

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def _prism(profile: np.ndarray, width: float, colour) -> TransducerShape:
    """The convex prism of a profile (n, 2) of x and z, centred on y = 0; each triangle has its own
    vertices.
    """
    ends = [np.insert(profile, 1, y, axis=1) for y in (-width / 2, width / 2)]
    hull = trimesh.convex.convex_hull(np.concatenate(ends))
    colours = np.tile(colour, (3 * len(hull.faces), 1))
    return TransducerShape(hull.triangles.reshape(-1, 3), np.repeat(hull.face_normals, 3, axis=0), colours)


def _rectangle(left: float, right: float, bottom: float, top: float) -> np.ndarray:
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def transducer(size, radius: float = 0.0) -> TransducerShape:
    """The housing, its acoustic lens, flat or an arc of a radius, and a marker on the +x side."""
    x, y, z = (float(length) for length in size)
    lens = min(LENS_MM, z / 4)
    face = _face(x, z, radius)
    top = face[:, 1].max() + lens
    middle = (z / 2 + top) / 2
    upper = np.array([[x / 2, top], [-x / 2, top]])
    parts = [
        _prism(_rectangle(-x / 2, x / 2, top, z / 2), y, BODY),
        _prism(np.concatenate([face, upper]), y, LENS),
        _prism(
            _rectangle(x / 2 - 0.25, x / 2 + 0.25, middle - 0.225 * z, middle + 0.225 * z), 0.3 * y, MARKER
        ),
    ]
    return TransducerShape(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _face(x: float, z: float, radius: float) -> np.ndarray:
    """The profile (n, 2) of the array face from -x to +x, lowest in its centre at -z / 2."""
    if radius == 0:
        return np.array([[-x / 2, -z / 2], [x / 2, -z / 2]])
    across = np.linspace(-x / 2, x / 2, ARC_POINTS)
    return np.column_stack([across, radius - np.sqrt(np.maximum(radius**2 - across**2, 0)) - z / 2])


def edges(size, radius: float = 0.0) -> np.ndarray:
    """The end points of the housing's straight edges, shape (24, 3), just outside so that the sides do not
    hide them.
    """
    x, y, z = (float(length) for length in size)
    foot = _face(x, z, radius)[:, 1].max()
    box = np.array([x, y, z / 2 - foot])
    return (_CORNERS * (box + 0.15) + [0.0, 0.0, (z / 2 + foot) / 2])[_EDGES].reshape(-1, 3)


def image_plane_grid(rows: int, columns: int) -> np.ndarray:
    """A grid of the image, row by row: fractions (rows * columns, 2) of scanline and depth."""
    down, across = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    return np.stack([across, down], axis=-1).reshape(-1, 2)


def grid_triangles(rows: int, columns: int) -> np.ndarray:
    """The vertex indices of two triangles in each cell of a grid, int32, shape ((rows - 1)(columns - 1),
    6).
    """
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    return (first + [0, columns, 1, 1, columns, columns + 1]).astype(np.int32)


def on_plane(shares: np.ndarray, view: View) -> np.ndarray:
    """Points (n, 2) on the image plane [mm] of fractions (n, 2) of scanline and depth: in a rectangle or a
    sector.
    """
    if view.sector is None:
        return (shares - [0.5, 0.0]) * [view.width_mm, view.depth_mm]
    radius, start, stop = view.sector
    angle = start + shares[:, 0] * (stop - start)
    reach = radius + shares[:, 1] * (view.depth_mm - view.above_mm)
    return np.column_stack([reach * np.sin(angle), reach * np.cos(angle) - radius])


def on_transducer(places: np.ndarray) -> np.ndarray:
    """Points (n, 3) of image plane points (n, 2); the origin is the centre of the face, depth is along -z."""
    return np.column_stack([places[:, 0], np.zeros(len(places)), -places[:, 1]])


def image_plane_frame(view: View) -> np.ndarray:
    """The end points of the sides of the image plane, shape (2 FRAME_SIDES, 3), just outside of it."""
    quarter = np.linspace(0, 1, FRAME_SIDES // 4, endpoint=False)
    low, high = np.full_like(quarter, -0.008), np.full_like(quarter, 1.008)
    sides = [(quarter, low), (high, quarter), (1 - quarter, high), (low, 1 - quarter)]
    around = on_transducer(on_plane(np.concatenate([np.column_stack(side) for side in sides]), view))
    return np.stack([around, np.roll(around, -1, axis=0)], axis=1).reshape(-1, 3)


def sampled(picture: np.ndarray, places: np.ndarray, view: View) -> np.ndarray:
    """Grey values (n,) in [0, 1] of an image at points (n, 2) of its plane [mm]."""
    share = (places + [view.width_mm / 2, view.above_mm]) / [view.width_mm, view.depth_mm]
    size = np.array(picture.shape[::-1])
    column, row = np.clip(np.floor(share * size), 0, size - 1).astype(np.intp).T
    return picture[row, column] / 255.0


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """World points (n, 3) of local ones at a rigid pose (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]
