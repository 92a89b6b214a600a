"""Closed surfaces: moved, and the volume that they hold."""

import numpy as np
import trimesh


def moved_by(mesh: trimesh.Trimesh, by_mm: np.ndarray) -> trimesh.Trimesh:
    """A surface moved by (3,) [mm], its vertices and faces in the order that they had."""
    return trimesh.Trimesh(mesh.vertices + by_mm, mesh.faces, process=False)


def volume_mm3(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume [mm^3] inside a closed surface of vertices (n, 3) [mm] and faces (m, 3)."""
    corner = vertices[faces].astype(float)
    return float(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6)
