"""Contact of the array face: contact area and compression of the tissue in front of it."""

from dataclasses import dataclass

import igl
import numpy as np

from ultrasound.probe import Probe
from ultrasound.probe_manipulator import sagitta

SPACING_MM = 0.75
# Points of the footprint are at most so far apart, and along each side at least so many.
FOOTPRINT_MM, LEAST_FOOTPRINT = 1.25, 9
# The surface is in contact where it is nearer to the face than this; contacts prevent more penetration.
CONTACT_MM = 0.5
# Barycentric tolerance: no gaps between triangles from rounding.
TOLERANCE = 1e-9


@dataclass(frozen=True)
class ArrayContact:
    """Contact area of the face, and the greatest compression of the tissue in front of it.

    Compression is how much shorter the tissue is than at rest, along the transducer's axis from where it
    enters the organ to where it exits it; 0 without contact.
    """

    area_mm2: float = 0.0
    compression_mm: float = 0.0


def face_points(size_mm: np.ndarray, radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) evenly over the face, in the transducer's axes [mm], and the area (n,) of each [mm^2]."""
    counts = np.maximum(np.rint(np.asarray(size_mm[:2]) / SPACING_MM).astype(int), 1)
    x, y = ((np.arange(n) + 0.5) / n * s - s / 2 for n, s in zip(counts, size_mm[:2], strict=True))
    x, y = (grid.ravel() for grid in np.meshgrid(x, y))
    points = np.column_stack([x, y, sagitta(x, radius_mm) - size_mm[2] / 2])
    slope = np.ones_like(x) if radius_mm == 0 else radius_mm / np.sqrt(np.maximum(radius_mm**2 - x**2, 1e-6))
    return points, slope * np.prod(np.asarray(size_mm[:2]) / counts)


def footprint(probe: Probe) -> np.ndarray:
    """The centre, edges and corners of the array face, and points between them (n, 3), in the transducer's
    axes [mm]; on rounded edges.
    """
    half, rounded = np.array(probe.housing_mm) / 2, probe.edge_radius_mm
    counts = (max(LEAST_FOOTPRINT, 2 * int(np.ceil(h / FOOTPRINT_MM)) + 1) for h in half[:2])
    x, y = np.meshgrid(*(h * np.linspace(-1, 1, n) for h, n in zip(half[:2], counts, strict=True)))
    points = np.column_stack([x.ravel(), y.ravel(), sagitta(x.ravel(), probe.radius_mm) - half[2]])
    if rounded == 0:
        return points
    core = np.clip(points, rounded - half, half - rounded)
    outward = points - core
    return core + rounded * outward / np.linalg.norm(outward, axis=1, keepdims=True)


def depth_in(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Depth [mm] of the deepest of points (n, 3) in a closed surface, vertices (v, 3) [mm]; 0 outside.

    What is inside is decided by the winding number.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = points[((points > low) & (points < high)).all(axis=1)]
    faces = np.ascontiguousarray(faces, np.int64)
    if len(points):
        points = points[igl.fast_winding_number(vertices, faces, points) > 0.5]
    if not len(points):
        return 0.0
    return float(np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0].max()))


def gap_to(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Distance [mm] from the nearest of points (n, 3) to a surface, vertices (v, 3) [mm]."""
    faces = np.ascontiguousarray(faces, np.int64)
    return float(np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0].min()))


def measure_contact(
    pose: np.ndarray,
    size_mm: np.ndarray,
    radius_mm: float,
    now_mm: np.ndarray,
    rest_mm: np.ndarray,
    faces: np.ndarray,
) -> ArrayContact:
    """The contact of a transducer at a pose (4, 4) with a closed surface, vertices (v, 3) deformed and at
    rest [mm].
    """
    points, area = face_points(size_mm, radius_mm)
    local = (now_mm - pose[:3, 3]) @ pose[:3, :3]
    corners = local[faces]
    half = np.asarray(size_mm[:2]) / 2
    # Reductions over an axis of three are slow in NumPy.
    a, b, c = (corners[:, i, :2] for i in range(3))
    outside = ((a > half) & (b > half) & (c > half)) | ((a < -half) & (b < -half) & (c < -half))
    under = np.flatnonzero(~outside.any(axis=1))
    weights, covered = _weights(corners[under], points[:, :2])
    if not covered.any():
        return ArrayContact()
    z = np.einsum("tkc,tc->tk", weights, corners[under, :, 2])
    a, b, c = (corners[under, i, :2] for i in range(3))
    # Faces the transducer.
    upward = (_cross(b - a, c - a) > 0)[:, None]
    enters = np.where(covered & upward & (z <= points[:, 2] + CONTACT_MM), z, -np.inf)
    first, top = enters.argmax(axis=0), enters.max(axis=0)
    contact = points[:, 2] - top <= CONTACT_MM
    exits = np.where(covered & ~upward & (z < top), z, -np.inf)
    last, bottom = exits.argmax(axis=0), exits.max(axis=0)
    through = np.flatnonzero(contact & np.isfinite(bottom))
    compression = 0.0
    if len(through):
        at_rest = [
            np.einsum("kc,kcx->kx", weights[t[through], through], rest_mm[faces[under[t[through]]]])
            for t in (first, last)
        ]
        shorter = np.linalg.norm(at_rest[0] - at_rest[1], axis=1) - (top[through] - bottom[through])
        compression = max(float(shorter.max()), 0.0)
    return ArrayContact(float(area[contact].sum()), compression)


def _weights(corners: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric weights (t, k, 3) of points (k, 2) in triangles (t, 3, 3) projected along z, and whether
    inside.
    """
    a, b, c = (corners[:, i, :2] for i in range(3))
    twice = _cross(b - a, c - a)
    safe = np.where(np.abs(twice) < 1e-12, np.inf, twice)
    to = points[None] - a[:, None]
    second = _cross(to, (c - a)[:, None]) / safe[:, None]
    third = _cross((b - a)[:, None], to) / safe[:, None]
    first = 1 - second - third
    inside = (first >= -TOLERANCE) & (second >= -TOLERANCE) & (third >= -TOLERANCE)
    return np.stack([first, second, third], axis=-1), inside & (np.abs(twice) >= 1e-12)[:, None]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
