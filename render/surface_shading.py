"""Shading of surfaces, and the drawing order of their faces.

GGUI shades by Lambert's law alone and blends by vertex alpha without sorting. Specular sheen and a rim that
stays visible on a translucent organ are therefore part of the vertex colours, and faces are sorted farthest
first.
"""

from typing import Any

import igl
import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.spatial import cKDTree

from sim.fields import array_of, field_of, fields_of, fill, fill_evenly, zeros
from sim.kernels import kernel

ORGAN, TINT = (0.66, 0.27, 0.23), (0.27, 0.69, 0.50)
SOLID, GLASS = 1.0, 0.30
CUT_EDGE_MM = 0.4

# A point on the plane of a cut, and the unit normal towards the side that is removed, (3,) each.
Cut = tuple[np.ndarray, np.ndarray]

Points: Any = ti.types.ndarray(tm.vec3, ndim=1)


class DrawnMesh:
    """Fields of triangles with a normal and a colour (3 or 4 channels) at each of ``count`` vertices,
    given anew for each frame.
    """

    def __init__(self, count: int, channels: int = 3) -> None:
        self._fields = fields_of(*np.zeros((2, count, 3)), np.zeros((count, channels)), within=1)

    def draw(self, scene, indices: np.ndarray, points, normals, colours) -> None:
        """Draw the triangles of vertex ``indices`` (3 m,), int32, into a scene."""
        fill(*zip(self._fields, (points, normals, colours), strict=True))
        scene.mesh(self._fields[0], indices, self._fields[1], per_vertex_color=self._fields[2])


class ShadedSurface:
    """Normals and colours of one triangle mesh whose vertices move.

    ``vertices`` is a field (n,) of 3-vectors [mm]; ``faces`` (m, 3), int32, have their normals outward.
    ``base`` is red, green and blue in [0, 1], (3,), or of each vertex (n, 3); ``gloss`` is the strength of
    the sheen, 0 of a matt surface.
    """

    def __init__(self, vertices, faces: np.ndarray, base=ORGAN, gloss: float = 0.30):
        self.vertices = vertices
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        count = vertices.shape[0]
        self.gloss = gloss
        self.base = np.broadcast_to(np.asarray(base, np.float32), (count, 3))
        self._base = field_of(self.base, within=1)
        around, start = igl.vertex_triangle_adjacency(self.faces, count)
        self.normal, self.colour = zeros(count, 3, within=1), zeros(count, 4, within=1)
        self._tint = zeros(count)
        self._tinted: np.ndarray | None = None
        self._faces = field_of(self.faces, 1)
        self._start, self._around = fields_of(start, around)

    def shade(self, eye, light, opacity: float = SOLID, cut: Cut | None = None) -> None:
        """Update normals and colours. A cut surface is solid."""
        places = eye, light, *(cut if cut is not None else np.zeros((2, 3)))
        self._shade(np.array(places, np.float32), float(opacity))

    @kernel
    def _shade(self, places: Points, opacity: float):
        """``places`` (4,) are the eye, the light, a point of the cut and its normal.

        A zero normal cuts nothing; else what is on its side of the plane is transparent.
        """
        for v in range(self.vertices.shape[0]):
            eye, light, cut_point, cut_normal, base = (
                places[0],
                places[1],
                places[2],
                places[3],
                self._base[v],
            )
            vertex = self.vertices[v]
            total = tm.vec3(0.0)
            for k in range(self._start[v], self._start[v + 1]):
                face = self._faces[self._around[k]]
                a = self.vertices[face[0]]
                total += (self.vertices[face[1]] - a).cross(self.vertices[face[2]] - a)
            n = total / ti.max(total.norm(), 1e-12)
            self.normal[v] = n
            to_eye = (eye - vertex).normalized()
            half = ((light - vertex).normalized() + to_eye).normalized()
            sheen = self.gloss * ti.max(n.dot(half), 0.0) ** 36
            rim = (1.0 - ti.abs(n.dot(to_eye))) ** 2
            alpha = ti.min(opacity + (1.0 - opacity) * (0.75 * rim + sheen), 1.0)
            if cut_normal.norm() > 0.5:
                # Not clamped: blending clamps each pixel, and a linear alpha is cut along the plane, not
                # along faces.
                alpha = 0.5 - (vertex - cut_point).dot(cut_normal) / CUT_EDGE_MM
            tinted = base + self._tint[v] * (tm.vec3(TINT) - base)
            self.colour[v] = tm.vec4(tinted * (1.0 - 0.25 * rim) + sheen, alpha)

    def base_near(self, points: np.ndarray) -> np.ndarray:
        """The colours (k, 3) of the vertices that are nearest to points (k, 3) [mm]."""
        if (self.base == self.base[:1]).all():
            return np.broadcast_to(self.base[0], (len(points), 3))
        return self.base[cKDTree(array_of(self.vertices)).query(points)[1]]

    def tint(self, vertices: np.ndarray | None) -> None:
        """Set which vertices (n,) bool are shown in TINT; None for none of them."""
        if vertices is not self._tinted:
            self._tinted = vertices
            if vertices is None:
                fill_evenly(self._tint, 0.0)
            else:
                fill((self._tint, vertices))

    def draw(
        self, scene, ahead: np.ndarray | None = None, cut: Cut | None = None, two_sided: bool = False
    ) -> None:
        """Draw the surface into a scene, in the order of ``indices``."""
        colours = dict(per_vertex_color=self.colour, two_sided=two_sided)
        scene.mesh(self.vertices, self.indices(ahead, cut), self.normal, **colours)

    def indices(self, ahead: np.ndarray | None = None, cut: Cut | None = None) -> np.ndarray:
        """Vertex indices of the faces, int32 (3 m,), farthest first along `ahead` if given, without faces
        removed by a cut.
        """
        if ahead is None:
            return self.faces.reshape(-1)
        vertices, faces = array_of(self.vertices), self.faces
        if cut is not None:
            point, side = cut
            # Though transparent, they would hide what is drawn behind them later.
            faces = faces[((vertices - point) @ side < 0)[faces].any(axis=1)]
        depth = vertices @ ahead.astype(vertices.dtype)
        # By decreasing distance along the view, as blending needs.
        return faces[np.argsort(-depth[faces].sum(axis=1), kind="stable")].reshape(-1)
