"""The score: marks on the organ's capsule at rest, joined to a closed line of shortest paths; and its file,
which 3D Slicer reads: a closed curve of its markups, LPS, mm.
"""

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import trimesh

from errors import UserError
from rehearsal.case import Case
from rehearsal.result_files import write_json

LEAST_MARKS = 3
# Distance of neighbouring points of the line [mm].
SPACING_MM = 1.0
# Distance of the points [mm] at which it is known which faces the line crosses.
CROSSED_MM = 0.2
# A mark within a face keeps this share of distance from its edges: so that no face of the divided surface is
# flat.
LEAST_SHARE = 0.02
# A line that encloses less than this share of a circle of its length is folded.
LEAST_ROUNDNESS = 0.02
NAME = "score.mrk.json"
SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"


class ResectionError(UserError):
    """A score or a cut that cannot be made; the message says why and what to do."""


@dataclass(frozen=True)
class ScoreLine:
    """A closed line on the organ's surface at rest, all in mm.

    ``marks`` (n, 3) in the order of the line; ``points`` (k, 3) along it, the last one before the first;
    ``direction`` (3,) is the unit normal of the area that it encloses, outward.
    """

    marks: np.ndarray
    points: np.ndarray
    direction: np.ndarray

    @property
    def length_mm(self) -> float:
        """Length of the closed line."""
        return float(np.linalg.norm(np.roll(self.points, -1, axis=0) - self.points, axis=1).sum())

    def frame(self) -> np.ndarray:
        """Rows (3, 3): two axes across the direction, the first along the longest extent of the line, and
        the direction.
        """
        across = self.points - self.points.mean(axis=0)
        across -= np.outer(across @ self.direction, self.direction)
        first = np.linalg.svd(across, full_matrices=False)[2][0]
        return np.stack([first, np.cross(self.direction, first), self.direction])


def score_line(organ: trimesh.Trimesh, marks: np.ndarray) -> ScoreLine:
    """Join marks (n, 3) [mm] near a closed surface to a line, in their order around their middle.

    Between neighbours it is a geodesic (Sharp & Crane 2020, "You can find geodesic paths in triangle meshes
    by just flipping edges"). Raises ResectionError.
    """
    if len(marks) < LEAST_MARKS:
        raise ResectionError(
            f"the score has {len(marks)} marks; expected {LEAST_MARKS} or more around the tumour"
        )
    # A rehearsal without a score need not wait for its import.
    import potpourri3d

    on_surface, normals = places_on(organ, marks)
    ordered = on_surface[around_middle(on_surface, normals)]
    vertices, faces, corners = with_vertices(organ, ordered)
    paths = potpourri3d.EdgeFlipGeodesicSolver(vertices, faces)
    pieces = [
        paths.find_geodesic_path(int(a), int(b))
        for a, b in zip(corners, np.roll(corners, -1), strict=True)
        if a != b
    ]
    points = evenly_spaced(np.concatenate([piece[:-1] for piece in pieces])) if pieces else ordered
    return ScoreLine(ordered, points, _direction(points, normals))


def places_on(organ: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest places (n, 3) on a surface to points (n, 3) [mm], and the surface's normals (n, 3)
    there.
    """
    vertices, faces = np.asarray(organ.vertices, float), np.asarray(organ.faces, np.int64)
    _, face, near = igl.point_mesh_squared_distance(np.atleast_2d(np.asarray(points, float)), vertices, faces)
    face, near = np.atleast_1d(face), np.atleast_2d(near)
    return near, np.asarray(organ.face_normals)[face]


def enclosed_by(organ: trimesh.Trimesh, line: ScoreLine) -> np.ndarray:
    """Which faces (f,) of a surface a line encloses: all that it divides from the largest part, without
    those that it crosses.
    """
    ahead = np.roll(line.points, -1, axis=0) - line.points
    steps = np.arange(0.0, 1.0, CROSSED_MM / SPACING_MM)
    points = (line.points[:, None] + steps[:, None] * ahead[:, None]).reshape(-1, 3)
    vertices, faces = np.asarray(organ.vertices, float), np.asarray(organ.faces, np.int64)
    free = np.ones(len(faces), bool)
    free[igl.point_mesh_squared_distance(points, vertices, faces)[1]] = False
    beside = organ.face_adjacency[free[organ.face_adjacency].all(axis=1)]
    parts = trimesh.graph.connected_component_labels(beside, len(faces))
    area = np.bincount(parts, np.where(free, organ.area_faces, 0.0))
    return free & (parts != area.argmax())


def around_middle(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The order (n,) of points (n, 3) by their angle around their middle, seen along the mean of normals
    (n, 3).
    """
    mean = normals.mean(axis=0)
    axes = np.linalg.svd(mean[None])[2][1:]
    x, y = ((points - points.mean(axis=0)) @ axes.T).T
    return np.argsort(np.arctan2(y, x), kind="stable")


def with_vertices(surface: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a surface on which each point (n, 3) is a vertex, and the
    points' vertices (n,).
    """
    vertices, faces = np.asarray(surface.vertices, float), np.asarray(surface.faces, np.int64)
    own = []
    for point in points:
        _, face, _ = igl.point_mesh_squared_distance(point[None], vertices, faces)
        at = int(np.atleast_1d(face)[0])
        a, b, c = faces[at]
        share = trimesh.triangles.points_to_barycentric(vertices[None, [a, b, c]], point[None])[0]
        share = np.clip(share, LEAST_SHARE, None)
        new = len(vertices)
        vertices = np.vstack([vertices, share @ vertices[[a, b, c]] / share.sum()])
        faces = np.vstack([np.delete(faces, at, axis=0), [[a, b, new], [b, c, new], [c, a, new]]])
        own.append(new)
    return vertices, faces, np.array(own)


def evenly_spaced(line: np.ndarray) -> np.ndarray:
    """Points about SPACING_MM apart along a closed line (k, 3)."""
    closed = np.vstack([line, line[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(8, int(np.ceil(along[-1] / SPACING_MM)))
    at = along[-1] * np.arange(count) / count
    return np.column_stack([np.interp(at, along, closed[:, axis]) for axis in range(3)])


def _direction(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit normal (3,) of the area inside a closed line.

    Raises ResectionError where the line is folded, or crosses itself.
    """
    around = points - points.mean(axis=0)
    area = 0.5 * np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)
    size = float(np.linalg.norm(area))
    length = float(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum())
    if size < LEAST_ROUNDNESS * length**2 / (4 * np.pi):
        raise ResectionError(
            f"the score of {length:.0f} mm encloses only {size:.0f} mm2; set its marks around the tumour"
        )
    direction = area / size
    direction *= 1.0 if direction @ normals.mean(axis=0) >= 0 else -1.0
    axes = np.linalg.svd(direction[None])[2][1:]
    if crosses_itself(around @ axes.T):
        raise ResectionError(
            "the score crosses itself; remove its last marks, and set them along one closed line"
        )
    return direction


def crosses_itself(polygon: np.ndarray) -> bool:
    """Whether two sides of a closed polygon (k, 2) cross."""
    start, end = polygon, np.roll(polygon, -1, axis=0)
    run = end - start

    def side(point: np.ndarray) -> np.ndarray:
        """Of each side (rows), on which side of it the points (columns) are."""
        to = point[None] - start[:, None]
        return run[:, None, 0] * to[..., 1] - run[:, None, 1] * to[..., 0]

    apart = side(start) * side(end) < 0
    crossing = apart & apart.T
    return bool(crossing.any())


def save_score(case: Case, line: ScoreLine, out: Path, prefix: str = "") -> Path:
    """Write a score in the patient at rest (the CT); return the file. Raises OSError."""
    points = (line.points + case.origin).round(4).tolist()
    curve = dict(
        type="ClosedCurve",
        coordinateSystem="LPS",
        coordinateUnits="mm",
        controlPoints=[
            dict(id=f"{number}", label=f"score-{number}", position=point, positionStatus="defined")
            for number, point in enumerate(points, 1)
        ],
    )
    path = out / f"{prefix}{NAME}"
    write_json({"@schema": SCHEMA, "markups": [curve]}, path)
    return path
