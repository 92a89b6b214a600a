"""Where the vessels enter a kidney: the deepest hollow of its medial side."""

import numpy as np
import trimesh

from scenes.patients.readers.segment_names import Side

# The hollow's floor is taken over this distance around its deepest place.
FLOOR_MM = 8.0
# How squarely a place must face the midline to be of the hilum.
LEAST_MEDIAL = 0.3


def hilum(organ: trimesh.Trimesh, side: Side) -> tuple[float, float, float]:
    """The middle of the hilum [mm], LPS, of a kidney's surface.

    The medial vertex farthest under the surface's convex hull; vessels reach a kidney from the midline.
    """
    medial = np.array([-1.0 if side == "left" else 1.0, 0.0, 0.0])
    hull = organ.convex_hull
    normals, offsets = hull.face_normals, (hull.face_normals * hull.triangles[:, 0]).sum(axis=1)
    depth = np.min(offsets - organ.vertices @ normals.T, axis=1)
    facing = organ.vertex_normals @ medial > LEAST_MEDIAL
    if not facing.any():
        facing[:] = True
    deepest = organ.vertices[np.argmax(np.where(facing, depth, -1.0))]
    floor = organ.vertices[np.linalg.norm(organ.vertices - deepest, axis=1) <= FLOOR_MM]
    x, y, z = floor.mean(axis=0).round(1).tolist()
    return x, y, z
