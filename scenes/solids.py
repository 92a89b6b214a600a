"""Solids inside closed surfaces, for Boolean operations (manifold3d)."""

import manifold3d
import numpy as np
import trimesh

from errors import PatientError


def solid_of(surface: trimesh.Trimesh, name: str) -> manifold3d.Manifold:
    """The solid inside a closed surface. Raises PatientError, which calls the surface ``name``."""
    mesh = manifold3d.Mesh64(
        np.array(surface.vertices, np.float64, order="C"), np.array(surface.faces, np.uint64, order="C")
    )
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        raise PatientError(
            f"the surface of the {name} cannot be cut ({solid.status().name}): expected a closed surface; "
            "repair it, for example in "
            "3D Slicer, and import the patient again"
        )
    return solid


def surface_of(solid: manifold3d.Manifold) -> tuple[trimesh.Trimesh, np.ndarray]:
    """The surface of a solid, and for each of its faces (f,) the ``original_id`` of the solid that it came
    from.
    """
    mesh = solid.to_mesh64()
    faces = np.asarray(mesh.tri_verts).astype(np.int64)
    origin = np.repeat(np.asarray(mesh.run_original_id), np.diff(np.asarray(mesh.run_index)) // 3)
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], faces, process=False), origin
