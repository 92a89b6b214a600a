"""The transducer and its image plane as triangles and lines, in the transducer's frame. NumPy only; lengths
in mm.

Local axes: x lateral, to the marked side; y elevation; z along the axis. The image plane leaves the face at
z = -size_z / 2 in the direction -z.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import trimesh

from render.viewer import TransducerHousing, View

# The lens over the array, which touches the tissue, is seen as such.
BODY, LENS, MARKER = (0.60, 0.65, 0.70), (0.10, 0.36, 0.42), (0.25, 0.77, 1.0)
FIN, CABLE = (0.45, 0.50, 0.55), (0.24, 0.26, 0.30)
LENS_MM = 2.5
FRAME_SIDES = 48
ARC_POINTS = 15
# Of a rounded edge.
EDGE_STEPS = 4
# The cable bends away from the tissue: its radius and angle, the pieces of it, and the sides of a piece.
BEND_MM, BEND_DEG, CABLE_PIECES, CABLE_SIDES = 45.0, 60.0, 8, 12

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]
)


class TransducerShape(NamedTuple):
    """Vertices of triangles, three for each, unit normals, and colours in [0, 1], (3 m, 3) each."""

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def transducer(housing: TransducerHousing) -> TransducerShape:
    """The housing, its acoustic lens, flat or an arc, a marker on the +x side, and any fin and cable."""
    x, y, z = housing.size_mm
    lens = min(LENS_MM, z / 4)
    curved = _face(x, z, housing.face_radius_mm)
    top = curved[:, 1].max() + lens
    middle = (z / 2 + top) / 2
    marker = _prism(x / 2 + 0.25 * np.array([-1, 1]), middle + 0.225 * z * np.array([-1, 1]), 0.3 * y)
    if housing.face_radius_mm == 0:
        body, face = _rounded(housing, top, z / 2), _rounded(housing, -z / 2, top)
    else:
        body = _prism(np.array([-x, x]) / 2, np.array([top, z / 2]), y)
        face = np.concatenate([_extruded(curved, y), _prism(np.array([-x, x]) / 2, np.array([top]), y)])
    solids = [(body, BODY), (face, LENS), (marker, MARKER)]
    if all(housing.fin_mm):
        length, width, height = housing.fin_mm
        solids.append((_prism(np.array([-length, length]) / 2, z / 2 + np.array([0, height]), width), FIN))
    if housing.cable_mm > 0:
        rings = _cable_rings(-x / 2, housing.cable_mm / 2)
        solids += [(np.concatenate(pair), CABLE) for pair in pairwise(rings)]
    parts = [_hull(points, colour) for points, colour in solids]
    return TransducerShape(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _hull(points: np.ndarray, colour: tuple[float, float, float]) -> TransducerShape:
    """The convex hull of points (n, 3); each triangle has its own vertices."""
    hull = trimesh.convex.convex_hull(points)
    colours = np.tile(colour, (3 * len(hull.faces), 1))
    return TransducerShape(hull.triangles.reshape(-1, 3), np.repeat(hull.face_normals, 3, axis=0), colours)


def _extruded(profile: np.ndarray, width: float) -> np.ndarray:
    """The vertices of a prism of a profile (n, 2) of x and z, centred on y = 0."""
    return np.concatenate([np.insert(profile, 1, y, axis=1) for y in (-width / 2, width / 2)])


def _prism(x: np.ndarray, z: np.ndarray, width: float) -> np.ndarray:
    """The vertices of a cuboid, or rectangle, over all pairs of x and z."""
    return _extruded(np.array([[a, c] for a in x for c in z]), width)


def _rounded(housing: TransducerHousing, low: float, high: float) -> np.ndarray:
    """The vertices of the housing with rounded edges, between two heights along z."""
    radius = housing.edge_radius_mm
    core = np.array(housing.size_mm) / 2 - radius
    quarter = np.linspace(0, np.pi / 2, EDGE_STEPS + 1)
    bends = np.concatenate([sign * (core[2] + radius * np.sin(quarter)) for sign in (-1, 1)])
    heights = np.concatenate([[low, high], bends[(bends > low) & (bends < high)]])
    reach = np.sqrt(np.maximum(radius**2 - np.maximum(np.abs(heights) - core[2], 0) ** 2, 0))
    arc = np.column_stack([np.cos(quarter), np.sin(quarter)])
    corners = [np.array([x, y]) for x in (-1, 1) for y in (-1, 1)]
    return np.concatenate(
        [
            np.insert(corner * (core[:2] + r * arc), 2, z, axis=1)
            for r, z in zip(reach, heights, strict=True)
            for corner in corners
        ]
    )


def _cable_rings(x: float, radius: float) -> list[np.ndarray]:
    """Circles (CABLE_SIDES, 3) around the cable, which leaves the end of the housing at x."""
    around = np.linspace(0, 2 * np.pi, CABLE_SIDES, endpoint=False)
    rings = []
    for turn in np.radians(np.linspace(0, BEND_DEG, CABLE_PIECES + 1)):
        centre = np.array([x - BEND_MM * np.sin(turn), 0.0, BEND_MM * (1 - np.cos(turn))])
        across = np.outer(np.cos(around), [np.sin(turn), 0.0, np.cos(turn)])
        rings.append(centre + radius * (across + np.outer(np.sin(around), [0.0, 1.0, 0.0])))
    return rings


def _face(x: float, z: float, radius: float) -> np.ndarray:
    """The profile (n, 2) of the array face from -x to +x, lowest in its centre at -z / 2."""
    if radius == 0:
        return np.array([[-x / 2, -z / 2], [x / 2, -z / 2]])
    across = np.linspace(-x / 2, x / 2, ARC_POINTS)
    return np.column_stack([across, radius - np.sqrt(np.maximum(radius**2 - across**2, 0)) - z / 2])


def edges(housing: TransducerHousing) -> np.ndarray:
    """The end points of the housing's straight edges, shape (24, 3), just outside so that the sides do not
    hide them.
    """
    x, y, z = housing.size_mm
    foot, radius = _face(x, z, housing.face_radius_mm)[:, 1].max(), housing.edge_radius_mm
    half = np.array([x, y, z / 2 - foot]) / 2 + 0.075
    ends = _CORNERS[_EDGES]
    along = ends[:, :1] != ends[:, 1:]
    inset = np.where(along, radius, radius * (1 - np.sqrt(0.5)))
    return (ends * (half - inset) + [0.0, 0.0, (z / 2 + foot) / 2]).reshape(-1, 3)


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
