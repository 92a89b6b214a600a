"""A coarse tetrahedral mesh embedded in the body: it maps deformed points to rest points.

The paper's method for the CT slice in the ultrasound plane ("Weighted matrix blending"): barycentric
coordinates of the plane in the deformed tetrahedra give its rest positions.
"""

from itertools import permutations

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh

from sim.device import is_too_small
from sim.fields import Field, field_of, fill, zeros
from sim.kernels import kernel
from sim.signed_distance import signed_distance
from sim.skinning import Carrier, Skin
from sim.stored_arrays import stored

# Barycentric tolerance, so that rounding leaves no gaps between tetrahedra.
SEAM = 1e-5
SEAM_MM = 1e-2
PARALLEL = 1e-12
# Six times the volume [mm^3] up to which a tetrahedron is flat and contains no pixel.
FLAT = 1e-3
# With fewer tetrahedra, one core of a CPU is faster than several.
PARALLEL_FROM = 1_000_000


class Embedding:
    """Tetrahedra of a regular grid around a closed surface, whose vertices move with the tissue.

    ``tetrahedron`` (m,): four vertex indices each, of a rest mesh without gaps (Kuhn's six tetrahedra per
    cell). Outside the body they move with the nearest point of its surface, but less with the distance and
    not at all at ``margin_mm``, so that the surroundings deform without gaps; ``share`` (n,) is the factor of
    each vertex.

    ``rest_from_plane`` (m + 1,) maps (u, v, w) of an image plane [mm] to rest positions, for each tetrahedron
    that ``locate_on_plane`` found on it; the last is for points in no tetrahedron, which do not move.
    """

    def __init__(
        self, carrier: Carrier, surface: trimesh.Trimesh, cell_mm: float, margin_mm: float = 0.0
    ) -> None:
        vertices, tetrahedra, share, at = stored(_embedding_mesh, surface, cell_mm, margin_mm)
        self.skin = Skin(carrier, vertices, at)
        self.share = field_of(share)
        self.count, self.vertices = len(tetrahedra), len(vertices)
        self.serial = is_too_small(self.count, PARALLEL_FROM)
        self.tetrahedron = field_of(tetrahedra, 1)
        self.on_plane = zeros(len(vertices), 2, within=1)
        # A field of its own: all tetrahedra read it, and so it fits in a core's cache.
        self.above_plane = zeros(len(vertices))
        self.rest_from_plane = zeros(self.count + 1, 3, 4, within=2)

    def update(self) -> None:
        """Move the vertices with the body."""
        self.skin.update()
        self._fade()

    @kernel
    def _fade(self):
        for v in range(self.vertices):
            rest = self.skin.rest[v]
            self.skin.vertices[v] = rest + self.share[v] * (self.skin.vertices[v] - rest)

    @kernel
    def locate_on_plane(
        self,
        plane_from_world: tm.mat4,
        world_from_plane: tm.mat4,
        pixel_mm: tm.vec2,
        first_mm: tm.vec2,
        rows: int,
        columns: int,
        owner: ti.template(),
    ):
        """Write to the first rows and columns of ``owner``, i32, the tetrahedron at each pixel of an image
        plane, ``count`` where there is none.

        The two matrices map world [mm] to (u, v, w), with the plane at w = 0, and back; pixel (row, column)
        is at u = first.x + column * pixel.x, v = first.y + row * pixel.y. Of overlapping tetrahedra the
        lowest index is taken, independent of threads; inverted and flat ones are left out.
        """
        for row in range(rows):
            for column in range(columns):
                owner[row, column] = self.count
        self.rest_from_plane[self.count] = world_from_plane[:3, :]
        for v in range(self.vertices):
            projected = plane_from_world @ tm.vec4(self.skin.vertices[v], 1.0)
            self.on_plane[v], self.above_plane[v] = projected.xy, projected.z
        ti.loop_config(serialize=self.serial)
        for n in range(self.count):
            # In serial order the last that marks a pixel has the lowest index.
            t = self.count - 1 - n
            node = self.tetrahedron[t]
            w = ti.Vector([self.above_plane[node[k]] for k in ti.static(range(4))])
            if w.min() <= 0.0 and w.max() >= 0.0:
                self.mark(t, node, pixel_mm, first_mm, rows, columns, owner)

    @ti.func
    def mark(self, t, node, pixel_mm, first_mm, rows, columns, owner: ti.template()):
        """Mark the pixels of a tetrahedron that the plane cuts, and store its map to rest positions, if
        any are in the image.
        """
        x = self.on_plane[node[0]]
        low, high = x, x
        for k in ti.static(range(1, 4)):
            low, high = ti.min(low, self.on_plane[node[k]]), ti.max(high, self.on_plane[node[k]])
        last_mm = first_mm + tm.vec2(columns - 1, rows - 1) * pixel_mm
        if (high >= first_mm - SEAM_MM).all() and (low <= last_mm + SEAM_MM).all():
            a = self.edge(node, 1)
            b, c = self.edge(node, 2), self.edge(node, 3)
            six_volumes = a.dot(b.cross(c))
            if six_volumes > FLAT:
                # Gradients of the barycentric coordinates of the last three corners, and these coordinates at
                # the plane's origin.
                slopes = ti.Matrix.rows([b.cross(c), c.cross(a), a.cross(b)]) / six_volumes
                at = -(slopes @ tm.vec3(x, self.above_plane[node[0]]))
                origin = self.skin.rest[node[0]]
                edges = [self.skin.rest[node[k]] - origin for k in ti.static(range(1, 4))]
                moved = ti.Matrix.cols(edges)
                linear, offset = moved @ slopes, moved @ at + origin
                self.rest_from_plane[t] = ti.Matrix.cols([linear[:, 0], linear[:, 1], linear[:, 2], offset])
                self.mark_pixels(t, node, slopes, at, pixel_mm, first_mm, rows, columns, owner)

    @ti.func
    def edge(self, node, k):
        """The edge from a tetrahedron's first corner to corner k, along the axes of the plane."""
        along = self.on_plane[node[k]] - self.on_plane[node[0]]
        return tm.vec3(along, self.above_plane[node[k]] - self.above_plane[node[0]])

    @ti.func
    def mark_pixels(self, t, node, slopes, at, pixel_mm, first_mm, rows, columns, owner: ti.template()):
        """Row by row, the span of columns in which all four barycentric coordinates are positive."""
        bottom, top = 1e30, -1e30
        for a, b in ti.static([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]):
            wa, wb = self.above_plane[node[a]], self.above_plane[node[b]]
            if wa * wb <= 0.0 and wa != wb:
                va = self.on_plane[node[a]].y
                v = va + (self.on_plane[node[b]].y - va) * wa / (wa - wb)
                bottom, top = ti.min(bottom, v), ti.max(top, v)
        first_row = ti.max(0, ti.cast(ti.floor((bottom - first_mm.y) / pixel_mm.y), ti.i32))
        last_row = ti.min(rows - 1, ti.cast(ti.ceil((top - first_mm.y) / pixel_mm.y), ti.i32))
        # Each coordinate is at + by_row * row + by_column * column; together they are 1.
        by_column, by_row = slopes[:, 0] * pixel_mm.x, slopes[:, 1] * pixel_mm.y
        start = at + slopes[:, 0] * first_mm.x + slopes[:, 1] * first_mm.y
        per_column, per_row = tm.vec4(-by_column.sum(), by_column), tm.vec4(-by_row.sum(), by_row)
        starts = tm.vec4(1.0 - start.sum(), start)
        for row in range(first_row, last_row + 1):
            left, right = -0.5, columns - 0.5
            for k in ti.static(range(4)):
                inside = starts[k] + per_row[k] * row + SEAM
                if per_column[k] > PARALLEL:
                    left = ti.max(left, -inside / per_column[k])
                elif per_column[k] < -PARALLEL:
                    right = ti.min(right, -inside / per_column[k])
                elif inside < 0.0:
                    right = -1.0
            # The ends may be NaN for a nearly flat tetrahedron: clamp them to the image.
            first = ti.max(ti.cast(ti.ceil(left), ti.i32), 0)
            last = ti.min(ti.cast(ti.floor(right), ti.i32), columns - 1)
            for column in range(first, last + 1):
                if ti.static(self.serial):
                    owner[row, column] = t
                else:
                    ti.atomic_min(owner[row, column], t)


class Unmoved:
    """The embedding of a body that does not move: every point is at its rest position."""

    count = 1

    def __init__(self) -> None:
        self.rest_from_plane = zeros(1, 3, 4, within=2)

    def update(self) -> None:
        """Nothing to do."""

    def locate_on_plane(
        self,
        plane_from_world: ti.Matrix,
        world_from_plane: ti.Matrix,
        pixel_mm: ti.Matrix,
        first_mm: ti.Matrix,
        rows: int,
        columns: int,
        owner: Field,
    ) -> None:
        """As ``Embedding.locate_on_plane``."""
        fill(
            (owner, np.zeros(owner.shape, int)), (self.rest_from_plane, world_from_plane.to_numpy()[None, :3])
        )


def _embedding_mesh(
    surface: trimesh.Trimesh, cell_mm: float, margin_mm: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3) [mm], tetrahedra (t, 4) in their order, each vertex's share (v,), and the tissue (v,
    3) that it moves with.
    """
    vertices, tetrahedra = tetrahedra_around(surface, cell_mm, margin_mm)
    # A tetrahedron that contains tissue extends this far outside: all of its vertices must move with the
    # tissue.
    extent = np.sqrt(3) * cell_mm
    distance, face = signed_distance(surface.vertices, surface.faces, vertices)
    outside = np.maximum(distance, 0.0)
    # Extrapolated along their gradient at the surface, displacements would fold the surroundings where a
    # probe presses.
    on_surface = trimesh.triangles.closest_point(surface.triangles[face], vertices)
    at = np.where(outside[:, None] > 0, on_surface, vertices)
    beyond = np.maximum(outside - extent, 0.0)
    # Where tetrahedra overlap after deformation, the lowest index is taken: those in or nearest to the organ
    # come first.
    layer = np.ceil(outside[tetrahedra].min(axis=1) / cell_mm)
    share = np.clip(1.0 - beyond / max(margin_mm - extent, cell_mm), 0.0, 1.0)
    return vertices, tetrahedra[np.argsort(layer, kind="stable")], share, at


def tetrahedra_around(
    surface: trimesh.Trimesh, cell_mm: float, margin_mm: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) float64 [mm] and tetrahedra (t, 4) of the grid cells whose centre is in the surface or
    near to it.

    Near: no farther outside than the margin and half of the cell's diagonal.
    """
    low = surface.vertices.min(axis=0) - cell_mm - margin_mm
    shape = np.ceil((surface.vertices.max(axis=0) + cell_mm + margin_mm - low) / cell_mm).astype(int)
    cells = np.indices(shape).reshape(3, -1).T
    distance = signed_distance(surface.vertices, surface.faces, low + cell_mm * (cells + 0.5))[0]
    cells = cells[distance <= margin_mm + cell_mm * np.sqrt(3) / 2]
    nodes = []
    for axes in permutations(range(3)):
        corner = np.zeros((4, 3), int)
        for step, axis in enumerate(axes):
            corner[step + 1 :, axis] = 1
        if np.linalg.det(corner[1:] - corner[0]) < 0:
            corner = corner[[0, 2, 1, 3]]
        nodes.append(cells[:, None] + corner)
    grid = np.concatenate(nodes)
    index = np.ravel_multi_index(tuple(np.moveaxis(grid, 2, 0)), tuple(shape + 1))
    used, tetrahedra = np.unique(index, return_inverse=True)
    vertices = low + cell_mm * np.column_stack(np.unravel_index(used, tuple(shape + 1)))
    return vertices, tetrahedra.reshape(index.shape)
