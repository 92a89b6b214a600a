"""The image plane of a transducer and the rest positions of the tissue on it."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
import taichi.math as tm
import trimesh
from trimesh.intersections import mesh_plane

from sim.embedding import Embedding, Unmoved
from sim.fields import array_of, fill

Image = ti.types.ndarray(ti.u8, ndim=2)
# Pixels of a row that are computed together (SIMD).
LANES = 8
Lanes = ti.types.vector(LANES, ti.f32)


@dataclass(frozen=True)
class ImagePlane:
    """The imaged rectangle of the transducer's plane.

    ``width_mm`` along the transducer's x, ``depth_mm`` along its -z, starting ``above_mm`` behind its face.
    ``world_from_plane`` (4, 4): x to the marked side, y down into the tissue, z to the transducer's y [mm].
    """

    world_from_plane: np.ndarray
    width_mm: float
    depth_mm: float
    above_mm: float = 0.0


@ti.data_oriented
class PlaneInTissue:
    """The tetrahedron of an embedding that contains each of ``pixels`` x ``pixels`` pixels of an image plane.

    ``owner`` (rows, columns) is its index, since the last ``locate``; ``grid`` are the size of a pixel and the centre (u, v) of the
    first one [mm].
    """

    def __init__(self, embedding: Embedding | Unmoved, pixels: int) -> None:
        self.embedding = embedding
        self.pixels = pixels
        self.owner = ti.field(ti.i32, (pixels, pixels))
        self.grid = ti.Vector.field(2, ti.f32, 2)

    def locate(self, plane: ImagePlane) -> None:
        """Find the tissue on a plane; the embedding must be up to date."""
        pixel = np.array([plane.width_mm, plane.depth_mm]) / self.pixels
        first = np.array([-plane.width_mm / 2, -plane.above_mm]) + pixel / 2
        fill((self.grid, np.stack([pixel, first])))
        given = np.linalg.inv(plane.world_from_plane), plane.world_from_plane, pixel, first
        inverse, world, pixel_mm, first_mm = (ti.Matrix(np.asarray(each, float).tolist()) for each in given)
        self.embedding.locate_on_plane(inverse, world, pixel_mm, first_mm, self.owner)

    def rest_grid(self, count: int) -> np.ndarray:
        """Return rest positions (rows, columns, 3) [mm] at count x count points evenly over the plane."""
        places = np.empty((count, count, 3), np.float32)
        self._rest_grid(*(tm.vec2(*each) for each in array_of(self.grid)), places)
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
        """Return the rest position of the tissue at a pixel's centre [mm]; the last two are ``grid``."""
        linear = self.embedding.rest_from_plane[self.owner[row, column]]
        u, v = first_mm.x + column * pixel_mm.x, first_mm.y + row * pixel_mm.y
        return linear[:, 0] * u + linear[:, 1] * v + linear[:, 3]

    @ti.func
    def rest_lanes(self, row, first):
        """As ``rest_at`` for LANES pixels of a row, axis by axis, and whether they are collinear at rest too.

        Pixels beyond the image repeat its last.
        """
        last = self.pixels - 1
        x, y, z = Lanes(0.0), Lanes(0.0), Lanes(0.0)
        owner = self.owner[row, first]
        same = True
        for lane in ti.static(range(1, LANES)):
            same &= self.owner[row, ti.min(first + lane, last)] == owner
        if same:
            # Most neighbours are in one tetrahedron, whose map keeps them on a line.
            start = self.rest_at(row, first, self.grid[0], self.grid[1])
            on = self.embedding.rest_from_plane[owner][:, 0] * self.grid[0].x
            steps = Lanes([float(lane) for lane in ti.static(range(LANES))])
            x, y, z = start.x + on.x * steps, start.y + on.y * steps, start.z + on.z * steps
        else:
            for lane in ti.static(range(LANES)):
                rest = self.rest_at(row, ti.min(first + lane, last), self.grid[0], self.grid[1])
                x[lane], y[lane], z[lane] = rest.x, rest.y, rest.z
        return x, y, z, same

    @ti.func
    def pixel_near(self, place):
        """Return row and column of the pixel nearest to (u, v) [mm]."""
        at = ti.round((place - self.grid[1]) / self.grid[0], ti.i32)
        return tm.clamp(at.y, 0, self.pixels - 1), tm.clamp(at.x, 0, self.pixels - 1)

    @ti.func
    def rest_from_plane(self, row, column):
        """Return the map (3, 4) from (u, v, w, 1) of the plane to the rest position [mm], at a pixel."""
        return self.embedding.rest_from_plane[self.owner[row, column]]

    @ti.func
    def is_tissue(self, row, column):
        """Whether the embedding contains the pixel."""
        return self.owner[row, column] < self.embedding.count


def plane_section(vertices: np.ndarray, faces: np.ndarray, plane_from_world: np.ndarray) -> np.ndarray:
    """Return the section of a closed surface (v, 3), (f, 3) [mm] with the plane w = 0: segments (n, 2, 2) of (u, v) [mm].

    ``plane_from_world`` (4, 4) is rigid: u to the marked side, v down into the tissue, w out of the plane.
    """
    in_plane = vertices @ plane_from_world[:3, :3].T + plane_from_world[:3, 3]
    surface = trimesh.Trimesh(in_plane, faces, process=False)
    return mesh_plane(surface, plane_normal=[0.0, 0.0, 1.0], plane_origin=[0.0, 0.0, 0.0])[..., :2]
