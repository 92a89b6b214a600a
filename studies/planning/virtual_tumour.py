"""A virtual tumour for a kidney that has none, as a target of planning."""

from dataclasses import replace

import numpy as np
import trimesh

from scenes.anatomy import LoadedAnatomy

RADIUS_MM = 10.0
# Depth of its top under the surface [mm], and its place along the organ: a share of the length from the lower pole.
UNDER_MM, ALONG = 1.5, 0.35


def with_tumour(anatomy: LoadedAnatomy, gravity: np.ndarray) -> LoadedAnatomy:
    """The anatomy with a ball just under the highest point of its organ, unless it has a tumour of its own."""
    if anatomy.tumour is not None:
        return anatomy
    organ, up = anatomy.organ, -np.asarray(gravity) / np.linalg.norm(gravity)
    axis = np.linalg.svd(organ.vertices - organ.vertices.mean(axis=0), full_matrices=False)[2][0]
    axis *= np.sign(axis[2])
    along = organ.vertices @ axis
    away = np.abs((along - along.min()) / np.ptp(along) - ALONG)
    near = np.flatnonzero(away < 0.1)
    top = near[np.argmax(organ.vertices[near] @ up)]
    centre = organ.vertices[top] - (RADIUS_MM + UNDER_MM) * organ.vertex_normals[top]
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS_MM)
    return replace(anatomy, tumour=trimesh.Trimesh(ball.vertices + centre, ball.faces, process=False))
