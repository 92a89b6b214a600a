"""The image plane of a transducer, carried back through the deformed tissue: a place on it -> where that was at rest."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.embedding import Embedding, Unmoved

Picture = ti.types.ndarray(ti.u8, ndim=2)
# Places that are computed together where there are many in a row.
LANES = 8
Lanes = ti.types.vector(LANES, ti.f32)


@dataclass(frozen=True)
class ImagePlane:
    """The part of the transducer's plane that is drawn.

    ``width_mm`` along the transducer's x, ``depth_mm`` along its -z, which starts ``above_mm`` behind its face.
    ``world_from_plane`` (4, 4): x to the marked side, y down into the tissue, z to the transducer's y [mm].
    """

    world_from_plane: np.ndarray
    width_mm: float
    depth_mm: float
    above_mm: float = 0.0


@ti.data_oriented
class PlaneInTissue:
    """Which tetrahedron of an embedding holds each of ``pixels`` x ``pixels`` places of an image plane.

    ``owner`` (rows, columns) since the last ``locate``; slice and echo are made of the same one.
    """

    def __init__(self, embedding: Embedding | Unmoved, pixels: int) -> None:
        self.embedding = embedding
        self.pixels = pixels
        self.owner = ti.field(ti.i32, (pixels, pixels))

    def locate(self, plane: ImagePlane) -> None:
        """Find the tissue on a plane, the embedding being up to date; ``pixel_mm`` and ``first_mm`` say where pixels are."""
        pixel = np.array([plane.width_mm, plane.depth_mm]) / self.pixels
        first = np.array([-plane.width_mm / 2, -plane.above_mm]) + pixel / 2
        self.pixel_mm, self.first_mm = ti.Vector(pixel.tolist()), ti.Vector(first.tolist())
        world = _matrix(plane.world_from_plane)
        inverse = _matrix(np.linalg.inv(plane.world_from_plane))
        self.embedding.locate_on_plane(inverse, world, self.pixel_mm, self.first_mm, self.owner)

    def rest_grid(self, count: int) -> np.ndarray:
        """Where the tissue of the plane was at rest [mm], at count x count places evenly over it, (rows, columns, 3)."""
        places = np.empty((count, count, 3), np.float32)
        self._rest_grid(self.pixel_mm, self.first_mm, places)
        return places

    @ti.kernel
    def _rest_grid(self, pixel_mm: tm.vec2, first_mm: tm.vec2, places: ti.types.ndarray(ti.f32, ndim=3)):
        for i, j in ti.ndrange(places.shape[0], places.shape[1]):
            row = (i * (self.pixels - 1)) // (places.shape[0] - 1)
            column = (j * (self.pixels - 1)) // (places.shape[1] - 1)
            rest = self.rest_at(row, column, pixel_mm, first_mm)
            for axis in ti.static(range(3)):
                places[i, j, axis] = rest[axis]

    @ti.func
    def rest_at(self, row, column, pixel_mm, first_mm):
        """Where the tissue at a pixel's centre was at rest [mm]."""
        linear = self.embedding.rest_from_plane[self.owner[row, column]]
        u, v = first_mm.x + column * pixel_mm.x, first_mm.y + row * pixel_mm.y
        return linear[:, 0] * u + linear[:, 1] * v + linear[:, 3]

    @ti.func
    def rest_lanes(self, row, first, pixel_mm, first_mm):
        """As ``rest_at``, of LANES pixels of a row, each axis by itself, and whether they are on one line at rest too.

        Those beyond the picture are its last.
        """
        last = self.pixels - 1
        x, y, z = Lanes(0.0), Lanes(0.0), Lanes(0.0)
        owner = self.owner[row, first]
        alike = True
        for lane in ti.static(range(1, LANES)):
            alike &= self.owner[row, ti.min(first + lane, last)] == owner
        if alike:
            # Most neighbours lie in one tetrahedron, which takes them back along a line.
            start = self.rest_at(row, first, pixel_mm, first_mm)
            on = self.embedding.rest_from_plane[owner][:, 0] * pixel_mm.x
            steps = Lanes([float(lane) for lane in ti.static(range(LANES))])
            x, y, z = start.x + on.x * steps, start.y + on.y * steps, start.z + on.z * steps
        else:
            for lane in ti.static(range(LANES)):
                rest = self.rest_at(row, ti.min(first + lane, last), pixel_mm, first_mm)
                x[lane], y[lane], z[lane] = rest.x, rest.y, rest.z
        return x, y, z, alike

    @ti.func
    def pixel_near(self, place, pixel_mm, first_mm):
        """Row and column of the pixel nearest to a place (u, v) [mm]."""
        at = ti.round((place - first_mm) / pixel_mm, ti.i32)
        return tm.clamp(at.y, 0, self.pixels - 1), tm.clamp(at.x, 0, self.pixels - 1)

    @ti.func
    def map_of(self, row, column):
        """The map (3, 4) from (u, v, w, 1) of the plane to where the tissue of a pixel was at rest [mm]."""
        return self.embedding.rest_from_plane[self.owner[row, column]]

    @ti.func
    def is_tissue(self, row, column):
        """Whether the embedding holds what a pixel shows."""
        return self.owner[row, column] < self.embedding.count


def _matrix(values: np.ndarray) -> ti.Matrix:
    return ti.Matrix(np.asarray(values, float).tolist())
