"""The 3D view drawn by a graphics card: GGUI's scene, given arrays.

GGUI's own methods take Taichi fields, and compile a kernel for each of them to copy it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from sim.fields import Field, array_of

# A vertex of GGUI: place (3), normal (3), place in a texture (2), colour (4).
VERTEX = 12


class GraphicsScene:
    """The methods of GGUI's scene that ``scene_view.py`` calls, for the fields of ``sim.fields``; ``info_of`` describes an array to GGUI."""

    def __init__(self, scene: Any, info_of: Callable) -> None:
        self.scene, self._info_of = scene, info_of

    def ambient_light(self, colour) -> None:
        """Light from everywhere."""
        self.scene.ambient_light(tuple(colour))

    def point_light(self, position, colour) -> None:
        """Light from a point [mm]."""
        self.scene.point_light(tuple(position), tuple(colour))

    def mesh(
        self, vertices: Field, indices: np.ndarray, normals: Field, per_vertex_color: Field, two_sided=False
    ) -> None:
        """Add triangles of vertex ``indices`` (3 m,), int32; fields (n,) of vertices [mm], normals, and colours with or without alpha."""
        packed = _packed(vertices, per_vertex_color)
        packed[:, 3:6] = array_of(normals)
        self.scene.scene.mesh(
            self._info_of(packed),
            True,
            self._info_of(indices),
            (0.5, 0.5, 0.5),
            two_sided,
            len(indices),
            0,
            len(packed),
            0,
            False,
        )

    def lines(
        self, points: Field, width: float, color=(0.5, 0.5, 0.5), per_vertex_color: Field | None = None
    ) -> None:
        """Add line segments between the points of a field (2 n,), of a width [pixels]."""
        packed = _packed(points, per_vertex_color)
        own = per_vertex_color is not None
        count = len(packed)
        self.scene.scene.lines(
            self._info_of(packed), self._info_of(None), own, tuple(color), width, count, 0, count, 0
        )


def _packed(points: Field, colours: Field | None) -> np.ndarray:
    """Vertices (n, VERTEX) float32, with alpha 1 where the colours have none."""
    packed = np.zeros((*points.shape, VERTEX), np.float32)
    packed[:, :3], packed[:, 11] = array_of(points), 1.0
    if colours is not None:
        packed[:, 8 : 8 + colours.element[0]] = array_of(colours)
    return packed
