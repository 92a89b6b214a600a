"""Distances on a grid against libigl's, point by point, in float64."""

import igl
import numpy as np
import pytest
import trimesh
from conftest import rotation_about

from sim.signed_distance import COARSENESS, EXACT_MM, distance_grid

# Float32 keeps places up to 64 mm from a corner of the grid so well; a distance takes some ten operations.
ROUNDING_MM = 10 * 4e-6


def with_slivers(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface with a face of no area in each of its first edges."""
    a, b = mesh.faces[:20, 0], mesh.faces[:20, 1]
    return trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, np.column_stack([a, b, b])]), process=False)


def turned_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((30, 20, 7))
    return trimesh.Trimesh(box.vertices @ rotation_about([1, 2, 3], 40).T, box.faces)


SURFACES = {
    "ball": trimesh.creation.icosphere(subdivisions=3, radius=14.0),
    "ring": trimesh.creation.torus(12.0, 4.0),
    "box": turned_box(),
    "slivers": with_slivers(trimesh.creation.icosphere(subdivisions=2, radius=14.0)),
    "two balls": trimesh.util.concatenate(
        [trimesh.creation.icosphere(subdivisions=2, radius=6.0).apply_translation([x, 0, 0]) for x in (-9, 9)]
    ),
}


@pytest.mark.parametrize("spacing_mm", [0.7, 2.0])
@pytest.mark.parametrize("surface", SURFACES)
def test_distances_are_to_the_nearest_face(one_device, surface, spacing_mm):
    mesh = SURFACES[surface]
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    distance, low = distance_grid(vertices, faces, spacing_mm, 8.0)
    points = low + spacing_mm * np.indices(distance.shape).reshape(3, -1).T
    squared = igl.point_mesh_squared_distance(points, vertices, faces)[0]
    exact = np.sqrt(squared).reshape(distance.shape)
    near = exact < EXACT_MM - ROUNDING_MM
    assert np.abs(np.abs(distance) - exact)[near].max() < ROUNDING_MM
    # A distance changes by no more than the distance to the corners of the coarse cell.
    off = COARSENESS * spacing_mm * 3**0.5
    assert np.abs(np.abs(distance) - exact).max() < max(off, ROUNDING_MM)
    assert np.abs(distance)[~near].min() >= EXACT_MM - ROUNDING_MM
    inside = (igl.winding_number(vertices, faces, points) > 0.5).reshape(distance.shape)
    clear = exact > ROUNDING_MM
    assert ((distance < 0) == inside)[clear].all()
    assert inside.any() and not inside.all()
