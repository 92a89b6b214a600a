"""Closed surfaces in LPS [mm]: read and written as files, translated; the volume inside one, and distances
from it.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import igl
import numpy as np
import trimesh
from scipy import ndimage
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl

from errors import PatientError
from scenes.atomic_files import atomic_write
from scenes.patient_space import Space, signs_to_lps

# The coordinate system, as 3D Slicer reads it from an STL's header and a PLY's comments.
SPACE = b"SPACE=LPS"
SPACE_FIELD = re.compile(r"\bSPACE ?= ?([\w-]+)")
STL_HEADER_BYTES = 80
ENDINGS = (".stl", ".ply", ".obj")
# Of surfaces that no installed library reads.
OTHER_ENDINGS = (".vtk", ".vtp", ".vtu", ".3mf", ".fbx")
MOST_BYTES, MOST_COMMENT_BYTES = 1 << 29, 1 << 16
# Of a grid, distances are computed at every second point first.
COARSENESS = 2
EXPECTED = "a closed surface in an STL, PLY or OBJ file, in mm"


@dataclass(frozen=True)
class FineSurface:
    """A closed surface with each of its faces divided in four.

    vertices (v, 3) [mm]: first the ``coarse_count`` of the surface, then the midpoints of its edges. coarse
    (f, 3): its faces; divided (f, 4, 3): the four of each.
    """

    vertices: np.ndarray
    coarse: np.ndarray
    divided: np.ndarray
    coarse_count: int

    @staticmethod
    def of(surface: trimesh.Trimesh) -> "FineSurface":
        """The fine surface of a surface."""
        whole = np.asarray(surface.vertices), np.asarray(surface.faces)
        vertices, faces, four = trimesh.remesh.subdivide(*whole, return_index=True)
        divided = np.array([faces[four[face]] for face in range(len(whole[1]))])
        return FineSurface(vertices, whole[1], divided, len(whole[0]))

    @property
    def faces(self) -> np.ndarray:
        """All faces (4 f, 3)."""
        return self.divided.reshape(-1, 3)

    def faces_where(self, is_near: np.ndarray) -> np.ndarray:
        """Faces (n, 3), divided where one of the ``coarse_count`` vertices ``is_near``, coarse elsewhere."""
        near = is_near[self.coarse].any(axis=1)
        return np.concatenate([self.coarse[~near], self.divided[near].reshape(-1, 3)])


def is_surface_file(path: Path) -> bool:
    """Whether a file name ends like that of a surface."""
    return path.suffix.lower() in ENDINGS


def load_surface(path: Path) -> trimesh.Trimesh:
    """Read a closed surface that faces outward, in the coordinates of its file [mm]. Raises PatientError."""
    surface = read_triangles(path)
    if not surface.is_watertight or surface.volume <= 0:
        raise PatientError(
            f"{path}: is not a closed surface that faces outward, or is incomplete; copy it again, or repair "
            "it, for example in 3D Slicer"
        )
    return surface


def read_triangles(path: Path) -> trimesh.Trimesh:
    """Read a surface, closed or not, in the coordinates of its file. Raises PatientError."""
    if not path.is_file():
        raise PatientError(f"{path}: no such surface file; give an STL, PLY or OBJ file")
    if path.stat().st_size > MOST_BYTES:
        raise PatientError(f"{path}: is larger than {MOST_BYTES >> 20} MiB; reduce its number of triangles")
    if path.stat().st_size == 0:
        raise PatientError(f"{path}: is empty, 0 bytes; expected {EXPECTED}; copy or export it again")
    try:
        # From an open file: the path would let an OBJ name files that are then read, such as textures.
        with path.open("rb") as file:
            surface = trimesh.load_mesh(file, file_type=path.suffix[1:].lower(), skip_materials=True)
    except MemoryError:
        raise
    except Exception:  # a damaged file is taken for other kinds, whose readers raise many kinds of error
        raise PatientError(
            f"{path}: is incomplete or damaged, or of another kind than its name ends in; expected "
            f"{EXPECTED}; copy or export it again"
        ) from None
    if not isinstance(surface, trimesh.Trimesh) or len(surface.faces) == 0:
        raise PatientError(
            f"{path}: has no triangles: it is incomplete or damaged, or no surface; expected {EXPECTED}; "
            "copy or export it again"
        )
    if not np.isfinite(surface.vertices).all():
        raise PatientError(
            f"{path}: has coordinates that are not finite; expected {EXPECTED}; export it again"
        )
    if not surface.is_watertight:
        # A corner with several normals, or places in a texture, is one vertex for each.
        surface.merge_vertices(merge_tex=True, merge_norm=True)
    return surface


def file_comments(path: Path) -> list[str]:
    """The texts in a surface file that are no geometry: the header of an STL, the comments of a PLY or
    OBJ.
    """
    with path.open("rb") as file:
        start = file.read(MOST_COMMENT_BYTES)
    kind = path.suffix.lower()
    if kind == ".ply":
        start = start.partition(b"end_header")[0]
    elif kind == ".stl":
        is_text = start.startswith(b"solid") and b"facet" in start
        start = start.partition(b"\n")[0].removeprefix(b"solid") if is_text else start[:STL_HEADER_BYTES]
        return re.findall(r"[^\W_][ -~\xa1-\xff]{2,}", start.decode("latin-1"))
    marks = {".ply": ("comment ", "obj_info "), ".obj": ("#",)}.get(kind, ())
    lines = start.decode("latin-1").splitlines()
    return [line.removeprefix(mark).strip() for line in lines for mark in marks if line.startswith(mark)]


def stated_space(path: Path) -> Space | None:
    """The coordinate system that a surface file states as 3D Slicer does, or None.

    Raises PatientError where it states two, or another.
    """
    spaces = {name for text in file_comments(path) for name in SPACE_FIELD.findall(text)}
    if len(spaces) > 1 or not spaces <= {"LPS", "RAS"}:
        raise PatientError(
            f"{path}: states SPACE={' and SPACE='.join(sorted(spaces))}; expected LPS or RAS; export it "
            "again from 3D Slicer"
        )
    return cast(Space, spaces.pop()) if spaces else None


def in_lps(surface: trimesh.Trimesh, space: Space | None) -> trimesh.Trimesh:
    """A surface of a coordinate system, None for LPS, in LPS; the order of vertices and faces stays."""
    signs = signs_to_lps(space or "LPS")
    faces = surface.faces if signs.prod() > 0 else surface.faces[:, ::-1]  # a mirror turns the triangles over
    return trimesh.Trimesh(surface.vertices * signs, faces, process=False)


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


def depth_below_hull(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """How far points (n, 3) are inside the convex hull of a surface, shape (n,) [mm]; negative outside."""
    hull = surface.convex_hull
    normals = hull.face_normals
    offsets = (normals * hull.triangles[:, 0]).sum(axis=1)
    return np.min(offsets - points @ normals.T, axis=1)


def volume_mm3(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume [mm^3] inside a closed surface of vertices (n, 3) [mm] and faces (m, 3)."""
    corner = vertices[faces].astype(float)
    return float(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6)


def signed_distance_from(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Distance [mm] of points (n, 3) from a closed surface, negative inside; shape (n,).

    libigl's own signed distance by winding numbers is that times 1 - 2 w, and w is approximate.
    """
    points = np.ascontiguousarray(points, float)
    vertices, faces = (
        np.ascontiguousarray(surface.vertices, float),
        np.ascontiguousarray(surface.faces, np.int64),
    )
    squared = igl.point_mesh_squared_distance(points, vertices, faces)[0]
    inside = igl.fast_winding_number(vertices, faces, points) > 0.5
    return np.where(inside, -1.0, 1.0) * np.sqrt(squared)


def distances_on_grid(
    surface: trimesh.Trimesh,
    low: np.ndarray,
    counts: tuple[int, ...],
    spacing_mm: float,
    exact_mm: tuple[float, float] = (-8.0, 8.0),
) -> np.ndarray:
    """Distances [mm] (nx, ny, nz) of a grid's points from a closed surface, negative inside; ``low`` (3,)
    [mm] is the first point.

    Exact from the first to the second of ``exact_mm``, elsewhere linear between every second point along each
    axis.
    """
    few = -(-(np.array(counts) - 1) // COARSENESS) + 1
    coarse = signed_distance_from(surface, _grid_points(low, few, COARSENESS * spacing_mm)).reshape(few)
    within = tuple(slice(n) for n in counts)
    distance = ndimage.zoom(coarse, (COARSENESS * (few - 1) + 1) / few, order=1)[within]
    near = (distance > exact_mm[0]) & (distance < exact_mm[1])
    distance[near] = signed_distance_from(surface, low + spacing_mm * np.argwhere(near))
    return distance


def _grid_points(low: np.ndarray, counts: np.ndarray, spacing_mm: float) -> np.ndarray:
    return low + spacing_mm * np.indices(tuple(counts)).reshape(3, -1).T
