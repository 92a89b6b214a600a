"""The mould under the organ: the paper's bed of plasticine.

Camara et al. 2016 laid the kidney phantom in plasticine; the virtual bead experiments describe it as the
lower 35 % of the organ's height, dilated by 0.3 mm and swept upwards, taken out of a block; its rim is
filleted.
"""

from collections.abc import Callable

import igl
import numpy as np
import trimesh
from skimage.measure import marching_cubes

from scenes.patients.label_surfaces import decimate

# Share of the organ's height, along gravity, inside the mould.
DEPTH = 0.35
CLEARANCE_MM = 0.3
# Least width of the block around the mould, and its thickness under the organ's lowest point.
WALL_MM, FLOOR_MM = 12.0, 8.0
# Radius of the mould's rim and of the block's edges.
FILLET_MM = 4.0
# Spacing of the sampling grid.
GRID_MM = 1.0
FACES = 5000
ATTEMPTS = 4
# Least share of the clearance anywhere.
LEAST_CLEARANCE = 0.25


def mould(
    organ: trimesh.Trimesh,
    gravity_direction: np.ndarray,
    clearance_mm: float = CLEARANCE_MM,
) -> trimesh.Trimesh:
    """Rigid block with a mould of the organ's underside, which the organ at rest does not touch.

    Args:
        organ: watertight surface at rest, normals outward; vertices [mm], shape (vertex_count, 3).
        gravity_direction: shape (3,), any length but zero.
        clearance_mm: gap between organ at rest and mould [mm]; the least gap is at least a quarter of it.

    Returns:
        Watertight mesh of one body, normals outward; same frame as `organ`, [mm].

    Raises:
        ValueError: gravity without direction, organ not watertight, or no shape with the
            clearance found.
    """
    frame = gravity_frame(np.asarray(gravity_direction, float))
    if not organ.is_watertight:
        raise ValueError("the organ's surface is not watertight: a support cannot be moulded on it")
    upright = organ.vertices.view(np.ndarray) @ frame.T
    organ_faces = organ.faces.view(np.ndarray).astype(np.int64)

    low, high = upright.min(axis=0), upright.max(axis=0)
    top = low[2] + DEPTH * (high[2] - low[2])
    bed = upright[upright[:, 2] <= top]
    block_low = np.append(bed.min(axis=0)[:2] - WALL_MM, low[2] - FLOOR_MM)
    block_high = np.append(bed.max(axis=0)[:2] + WALL_MM, top)

    grid = grid_over(block_low, block_high, GRID_MM)
    gap = distance_to_swept(upright, organ_faces, grid)

    def carved(gap_mm: float) -> trimesh.Trimesh:
        return contour(_carved_block(grid, gap - gap_mm, block_low, block_high, FILLET_MM), grid)

    support = with_clearance(upright, organ_faces, carved, clearance_mm)
    return trimesh.Trimesh(support.vertices @ frame, support.faces, process=False)


def with_clearance(
    organ_vertices: np.ndarray,
    organ_faces: np.ndarray,
    carved: Callable[[float], trimesh.Trimesh],
    clearance_mm: float,
) -> trimesh.Trimesh:
    """A support with a clearance to the organ at rest; ``carved`` makes one with a given gap [mm]. Raises ValueError.

    Decimation moves the mould towards the organ; the gap is increased until the clearance is met.
    """
    gap_mm = clearance_mm
    for _ in range(ATTEMPTS):
        support = carved(gap_mm)
        least = least_gap(support.vertices, support.faces, organ_vertices, organ_faces)
        if least >= LEAST_CLEARANCE * clearance_mm:
            return support
        gap_mm += clearance_mm - least
    raise ValueError(
        f"the support has a clearance of {least:.2f} mm to the organ; expected {clearance_mm} mm"
    )


def least_gap(
    support_vertices: np.ndarray,
    support_faces: np.ndarray,
    organ_vertices: np.ndarray,
    organ_faces: np.ndarray,
) -> float:
    """Least signed distance [mm] between closed surfaces, at the vertices of both; negative: overlap."""
    gaps = []
    for points, vertices, faces in (
        (support_vertices, organ_vertices, organ_faces),
        (organ_vertices, support_vertices, support_faces),
    ):
        gaps.append(
            igl.signed_distance(
                np.ascontiguousarray(points, float),
                np.ascontiguousarray(vertices, float),
                np.ascontiguousarray(faces, np.int64),
                igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
            )[0].min()
        )
    return float(min(gaps))


def gravity_frame(gravity: np.ndarray) -> np.ndarray:
    """Rotation matrix whose rows are two horizontal axes and the upward axis; patient axes where possible."""
    length = np.linalg.norm(gravity)
    if gravity.shape != (3,) or not np.isfinite(length) or length == 0:
        raise ValueError(f"gravity_direction is {gravity}: expected three numbers, not all zero")
    up = -gravity / length
    level = np.eye(3)[np.argmin(np.abs(up))]
    level = level - (level @ up) * up
    level /= np.linalg.norm(level)
    return np.array([level, np.cross(up, level), up])


def grid_over(low: np.ndarray, high: np.ndarray, step: float) -> tuple[np.ndarray, ...]:
    """Axes of a grid around a block with one empty cell on each side; the block's faces are between nodes."""
    return tuple(
        np.arange(start - 1.5 * step, end + 2.0 * step, step) for start, end in zip(low, high, strict=True)
    )


def distance_to_swept(vertices: np.ndarray, faces: np.ndarray, grid: tuple[np.ndarray, ...]) -> np.ndarray:
    """Distance [mm] from the grid's nodes to the organ swept upwards to infinity; negative inside.

    The distance to a union is the minimum of the distances to its parts, and a copy of the organ raised by t is as far from
    a point as the organ is from the point t lower: a running minimum along the upward axis.
    """
    nodes = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1)
    distance = igl.signed_distance(
        nodes.reshape(-1, 3),
        np.ascontiguousarray(vertices),
        faces,
        igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]
    return np.minimum.accumulate(distance.reshape(nodes.shape[:3]), axis=2)


def _carved_block(
    grid: tuple[np.ndarray, ...], cavity: np.ndarray, low: np.ndarray, high: np.ndarray, fillet: float
) -> np.ndarray:
    """Level function of block minus cavity, negative in the material, its convex edges rounded."""
    x, y, z = np.meshgrid(*grid, indexing="ij", sparse=True)
    sides = rounded_intersection(
        np.maximum(low[0] - x, x - high[0]), np.maximum(low[1] - y, y - high[1]), radius=fillet
    )
    walls = np.maximum(sides, low[2] - z)
    return rounded_intersection(
        rounded_intersection(walls, z - high[2], radius=0.25 * fillet), -cavity, radius=fillet
    )


def rounded_intersection(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Intersection of two solids given by signed distances, their common edge rounded to `radius`."""
    corner = np.hypot(np.maximum(a + radius, 0.0), np.maximum(b + radius, 0.0)) - radius
    return np.minimum(np.maximum(a, b), -radius) + np.maximum(corner + radius, 0.0)


def contour(level: np.ndarray, grid: tuple[np.ndarray, ...]) -> trimesh.Trimesh:
    """Zero level on the grid, of about FACES triangles, one body, normals outward."""
    step = grid[0][1] - grid[0][0]
    clear = 1e-3 * step  # a level of exactly zero at a node gives triangles of no area
    level = np.where(level < 0, np.minimum(level, -clear), np.maximum(level, clear))
    vertices, triangles, _, _ = marching_cubes(level, 0.0, spacing=(step,) * 3)
    fine = trimesh.Trimesh(vertices + [axis[0] for axis in grid], triangles, process=False)
    if fine.volume < 0:
        fine.invert()
    return decimate(fine, FACES)
