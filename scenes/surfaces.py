"""Closed surfaces in LPS [mm]: read and written as files, translated; the volume inside one, and distances from it."""

from pathlib import Path

import igl
import numpy as np
import trimesh
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl

from errors import PatientError
from scenes.atomic_files import atomic_write

# The coordinate system, as 3D Slicer reads it from an STL's header and a PLY's comments.
SPACE = b"SPACE=LPS"
STL_HEADER_BYTES = 80
EXPECTED = "a closed surface in an STL, PLY or OBJ file, in mm, LPS"


def load_surface(path: Path) -> trimesh.Trimesh:
    """Read a closed surface that faces outward [mm, LPS]. Raises PatientError."""
    if not path.is_file():
        raise PatientError(f"{path}: no such surface file; give an STL, PLY or OBJ file")
    if path.stat().st_size == 0:
        raise PatientError(f"{path}: is empty, 0 bytes; expected {EXPECTED}; copy or export it again")
    try:
        # A damaged file is taken for other kinds, whose readers raise many kinds of error.
        surface = trimesh.load_mesh(path)
    except Exception:
        raise PatientError(
            f"{path}: is incomplete or damaged, or of another kind than its name ends in; expected {EXPECTED}; copy or export it again"
        ) from None
    if not isinstance(surface, trimesh.Trimesh) or len(surface.faces) == 0:
        raise PatientError(
            f"{path}: has no triangles: it is incomplete or damaged, or no surface; expected {EXPECTED}; copy or export it again"
        )
    if not np.isfinite(surface.vertices).all():
        raise PatientError(
            f"{path}: has coordinates that are not finite; expected {EXPECTED}; export it again"
        )
    if not surface.is_watertight or surface.volume <= 0:
        raise PatientError(
            f"{path}: is not a closed surface that faces outward, or is incomplete; copy it again, or repair it, for example in 3D Slicer"
        )
    return surface


def save_surface(surface: trimesh.Trimesh, path: Path) -> None:
    """Write vertices and triangles [mm, LPS] as binary STL or PLY, by the suffix, without any metadata.

    Coordinates are float32. A PLY keeps the order of the vertices. Raises OSError.
    """
    bare = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    with atomic_write(path) as partial:
        partial.write_bytes(WRITERS[path.suffix.removeprefix(".")](bare))


def _stl(surface: trimesh.Trimesh) -> bytes:
    return SPACE.ljust(STL_HEADER_BYTES) + export_stl(surface)[STL_HEADER_BYTES:]


def _ply(surface: trimesh.Trimesh) -> bytes:
    magic, encoding, rest = export_ply(surface, vertex_normal=False).split(b"\n", 2)
    return b"\n".join([magic, encoding, b"comment " + SPACE, rest])


WRITERS = {"stl": _stl, "ply": _ply}
FORMATS = tuple(WRITERS)


def translated(mesh: trimesh.Trimesh, by_mm: np.ndarray) -> trimesh.Trimesh:
    """The surface translated by (3,) [mm], with the same order of vertices and faces."""
    return trimesh.Trimesh(mesh.vertices + by_mm, mesh.faces, process=False)


def volume_mm3(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume [mm^3] inside a closed surface of vertices (n, 3) [mm] and faces (m, 3)."""
    corner = vertices[faces].astype(float)
    return float(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6)


def signed_distance_from(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Distance [mm] of points (n, 3) from a closed surface, negative inside; shape (n,)."""
    return igl.signed_distance(
        np.ascontiguousarray(points, float),
        np.ascontiguousarray(surface.vertices, float),
        np.ascontiguousarray(surface.faces, np.int64),
        igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]
