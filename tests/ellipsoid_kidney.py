"""A left kidney from closed forms: an ellipsoid with balls as tumours, bites and sinus; surfaces in LPS
[mm].
"""

import igl
import numpy as np
import trimesh

HALF_AXES = np.array([28.0, 22.0, 55.0])
MEDIAL = np.array([-1.0, 0.0, 0.0])
STEP_MM = 1.5


def in_ellipsoid(points):
    """Approximate signed distance [mm] from the ellipsoid, its zero exact; negative inside."""
    scaled = points / HALF_AXES
    length = np.linalg.norm(scaled, axis=-1)
    return length * (length - 1) / np.maximum(np.linalg.norm(scaled / HALF_AXES, axis=-1), 1e-9)


def in_ball(centre, radius):
    return lambda points: np.linalg.norm(points - np.asarray(centre), axis=-1) - radius


def surface(field, reach_mm=(60.0, 50.0, 75.0)):
    """The surface where a field is zero, outward."""
    # No grid point is on a surface of symmetry: triangles would degenerate.
    axes = [np.arange(-reach + 0.37, reach, STEP_MM) for reach in reach_mm]
    points = np.column_stack([grid.ravel(order="F") for grid in np.meshgrid(*axes, indexing="ij")])
    vertices, faces, _ = igl.marching_cubes(field(points), points, *map(len, axes), 0.0)
    mesh = trimesh.Trimesh(vertices, faces)
    if mesh.volume < 0:
        mesh.invert()
    assert mesh.is_watertight
    return mesh


def ball(centre, radius):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def kidney(*balls, bite=None):
    """The ellipsoid and balls (centre, radius) in one surface, without a bite (centre, radius)."""

    def field(points):
        found = in_ellipsoid(points)
        if bite is not None:
            found = np.maximum(found, -in_ball(*bite)(points))
        return np.minimum.reduce([found, *(in_ball(*each)(points) for each in balls)])

    return surface(field)
