"""Surfaces as files that other programs put in the right place in the patient."""

from pathlib import Path

import trimesh
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl

from scenes.whole_files import whole

# What 3D Slicer looks for in an STL's header and in a PLY's comments.
SPACE = b"SPACE=LPS"
STL_HEADER_BYTES = 80


def save_surface(surface: trimesh.Trimesh, path: Path) -> None:
    """Write vertices and triangles [mm, LPS] as binary STL or PLY, as the suffix says, and nothing else that is known of them.

    Coordinates are float32 there. A PLY keeps the order of the vertices, an STL has none. Raises OSError.
    """
    bare = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    with whole(path) as partial:
        partial.write_bytes(WRITERS[path.suffix.removeprefix(".")](bare))


def _stl(surface: trimesh.Trimesh) -> bytes:
    return SPACE.ljust(STL_HEADER_BYTES) + export_stl(surface)[STL_HEADER_BYTES:]


def _ply(surface: trimesh.Trimesh) -> bytes:
    magic, encoding, rest = export_ply(surface, vertex_normal=False).split(b"\n", 2)
    return b"\n".join([magic, encoding, b"comment " + SPACE, rest])


WRITERS = {"stl": _stl, "ply": _ply}
FORMATS = tuple(WRITERS)
