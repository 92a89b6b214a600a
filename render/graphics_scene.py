"""The 3D view drawn by a graphics card: GGUI's scene, given arrays.

GGUI's own methods take Taichi fields, and compile a kernel for each of them to copy it.
"""

from typing import Any

import numpy as np

from sim.fields import Field, array_of
from sim.taichi_internals import VERTEX, add_lines, add_mesh


class GraphicsScene:
    """The methods of GGUI's scene that ``scene_view.py`` calls, for the fields of ``sim.fields``."""

    def __init__(self, scene: Any) -> None:
        self.ggui_scene = scene

    def ambient_light(self, colour) -> None:
        """Light from everywhere."""
        self.ggui_scene.ambient_light(tuple(colour))

    def point_light(self, position, colour) -> None:
        """Light from a point [mm]."""
        self.ggui_scene.point_light(tuple(position), tuple(colour))

    def mesh(
        self, vertices: Field, indices: np.ndarray, normals: Field, per_vertex_color: Field, two_sided=False
    ) -> None:
        """Add triangles of vertex ``indices`` (3 m,), int32.

        Vertices [mm], normals, and colours with or without alpha are fields (n,).
        """
        packed = _packed(vertices, per_vertex_color)
        packed[:, 3:6] = array_of(normals)
        add_mesh(self.ggui_scene, packed, indices, two_sided)

    def lines(
        self, points: Field, width: float, color=(0.5, 0.5, 0.5), per_vertex_color: Field | None = None
    ) -> None:
        """Add line segments between the points of a field (2 n,), of a width [pixels]."""
        own_colour = tuple(color) if per_vertex_color is None else None
        add_lines(self.ggui_scene, _packed(points, per_vertex_color), width, own_colour)


def _packed(points: Field, colours: Field | None) -> np.ndarray:
    """Vertices (n, VERTEX) float32, with alpha 1 where the colours have none."""
    packed = np.zeros((*points.shape, VERTEX), np.float32)
    packed[:, :3], packed[:, 11] = array_of(points), 1.0
    if colours is not None:
        packed[:, 8 : 8 + colours.element[0]] = array_of(colours)
    return packed
