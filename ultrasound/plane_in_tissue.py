"""The image plane in deformed tissue: which tetrahedron contains each pixel, and where its tissue was at
rest.
"""

import zlib

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.embedding import Embedding, Unmoved
from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.sampled_volume import LANES, Lanes


class PlaneInTissue:
    """The tetrahedron of an embedding that contains each pixel of an image plane, which has at most
    ``pixels`` x ``pixels``.

    Since the last ``locate``, number ``location``, the image has ``shape`` (rows, columns), ``owner`` is the
    tetrahedron's index at these, ``grid`` the size of a pixel and the centre (u, v) of the first one [mm].
    """

    def __init__(self, embedding: Embedding | Unmoved, pixels: int) -> None:
        self.embedding = embedding
        self.pixels = pixels
        self.shape = pixels, pixels
        self.owner = zeros(pixels, pixels, kind=ti.i32)
        self.grid = zeros(2, 2, within=1)
        self._last = zeros(2, within=1, kind=ti.i32)
        # Size of a pixel and centre of the first one, of an image of all pixels.
        self._whole = np.zeros((2, 2))
        self._rest_grids: dict[int, np.ndarray] = {}
        # Changes with the plane: electronic noise is still only where the probe is.
        self.noise_key = 0
        self.location = 0

    def locate(self, plane: ImagePlane, shape: tuple[int, int] | None = None) -> None:
        """Find the tissue on a plane, for an image of a shape [all pixels]; the embedding must be up to date.

        Raises ValueError for a shape of more pixels than there are.
        """
        rows, columns = shape or (self.pixels, self.pixels)
        if max(rows, columns) > self.pixels:
            raise ValueError(f"an image of {rows} x {columns} pixels: at most {self.pixels} each way")
        self.shape, self.location = (rows, columns), self.location + 1
        size, corner = (
            np.array([plane.width_mm, plane.depth_mm]),
            np.array([-plane.width_mm / 2, -plane.above_mm]),
        )
        whole = size / self.pixels
        self._whole = np.stack([whole, corner + whole / 2])
        pixel = size / [columns, rows]
        first = corner + pixel / 2
        fill((self.grid, np.stack([pixel, first])), (self._last, np.array([rows - 1, columns - 1])))
        self._rest_grids.clear()
        self.noise_key = zlib.crc32(np.asarray(plane.world_from_plane, np.float32).tobytes()) & 0xFFFF
        arrays = np.linalg.inv(plane.world_from_plane), plane.world_from_plane, pixel, first
        inverse, world, pixel_mm, first_mm = (
            ti.Matrix(np.asarray(array, float).tolist()) for array in arrays
        )
        self.embedding.locate_on_plane(inverse, world, pixel_mm, first_mm, rows, columns, self.owner)

    @property
    def grid_mm(self) -> tuple[ti.Vector, ti.Vector]:
        """The values of ``grid``: as arguments of a kernel they cost its pixels nothing."""
        pixel, first = array_of(self.grid)
        return tm.vec2(*pixel), tm.vec2(*first)

    def rest_grid(self, count: int) -> np.ndarray:
        """Rest positions (count, count, 3) [mm] at pixels evenly over the plane, whatever the shape.

        They are not to be changed.
        """
        if count not in self._rest_grids:
            self._rest_grids[count] = np.empty((count, count, 3), np.float32)
            pixel, first = self._whole
            self._rest_grid(tm.vec2(*pixel), tm.vec2(*first), self._rest_grids[count])
        return self._rest_grids[count]

    @kernel
    def _rest_grid(self, pixel_mm: tm.vec2, first_mm: tm.vec2, places: ti.types.ndarray(ti.f32, ndim=3)):
        for i, j in ti.ndrange(places.shape[0], places.shape[1]):
            row = (i * (self.pixels - 1)) // (places.shape[0] - 1)
            column = (j * (self.pixels - 1)) // (places.shape[1] - 1)
            place = first_mm + tm.vec2(column, row) * pixel_mm
            near_row, near_column = self.pixel_near(place)
            rest = self.rest_from_plane(near_row, near_column) @ tm.vec4(place, 0.0, 1.0)
            for axis in ti.static(range(3)):
                places[i, j, axis] = rest[axis]

    @ti.func
    def rest_at(self, row, column, pixel_mm, first_mm):
        """The rest position of the tissue at a pixel's centre [mm]; the last two are ``grid``."""
        linear = self.embedding.rest_from_plane[self.owner[row, column]]
        u, v = first_mm.x + column * pixel_mm.x, first_mm.y + row * pixel_mm.y
        return linear[:, 0] * u + linear[:, 1] * v + linear[:, 3]

    @ti.func
    def rest_lanes(self, row, first, pixel_mm, first_mm, last):
        """As ``rest_at`` for LANES pixels of a row, axis by axis, and whether they are collinear at rest too.

        Pixels beyond the last column of the image repeat it.
        """
        x, y, z = Lanes(0.0), Lanes(0.0), Lanes(0.0)
        owner = self.owner[row, first]
        same = True
        for lane in ti.static(range(1, LANES)):
            same &= self.owner[row, ti.min(first + lane, last)] == owner
        if same:
            # Most neighbours are in one tetrahedron, whose map keeps them on a line.
            start = self.rest_at(row, first, pixel_mm, first_mm)
            on = self.embedding.rest_from_plane[owner][:, 0] * pixel_mm.x
            steps = Lanes([float(lane) for lane in ti.static(range(LANES))])
            x, y, z = start.x + on.x * steps, start.y + on.y * steps, start.z + on.z * steps
        else:
            for lane in ti.static(range(LANES)):
                rest = self.rest_at(row, ti.min(first + lane, last), pixel_mm, first_mm)
                x[lane], y[lane], z[lane] = rest.x, rest.y, rest.z
        return x, y, z, same

    @ti.func
    def pixel_near(self, place):
        """Row and column of the pixel nearest to (u, v) [mm]."""
        at = ti.round((place - self.grid[1]) / self.grid[0], ti.i32)
        last = self._last[None]
        return tm.clamp(at.y, 0, last[0]), tm.clamp(at.x, 0, last[1])

    @ti.func
    def rest_from_plane(self, row, column):
        """The map (3, 4) from (u, v, w, 1) of the plane to the rest position [mm], at a pixel."""
        return self.embedding.rest_from_plane[self.owner[row, column]]

    @ti.func
    def is_tissue(self, row, column):
        """Whether the embedding contains the pixel."""
        return self.owner[row, column] < self.embedding.count
