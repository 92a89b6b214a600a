"""The 3D view drawn by the processor, with the methods of GGUI's scene that ``scene_view.py`` calls.

Where there is no graphics card, Mesa imitates one at 100 ms a picture; this takes a few. Vertices are lit as
by GGUI (Lambert's law), triangles drawn in their order with a depth buffer, blended by alpha, and clipped to
a box of the window.
"""

from typing import NamedTuple

import numpy as np
import taichi as ti
import taichi.math as tm

from render.camera import OrbitCamera
from render.window_layout import Rect
from sim.fields import array_of
from sim.taichi_internals import TASK

# Each band of columns is drawn by one thread, all triangles in their order: so the picture does not depend on
# the threads.
BANDS = 4
# Farther outside, a column or row is cut off before it becomes an integer.
MOST_PIXELS = 1e6
# Lines are drawn this much nearer, as a share of their distance, so that the surface that they are on does
# not hide them.
LINE_NEARER = 1e-3

# Points on the screen (n, 3): column and row from the bottom [pixels], and 1 / distance; their colours (n,
# 4), 0 to 1 and above; triangles (m, 3) of them.
Projected = tuple[np.ndarray, np.ndarray, np.ndarray]


class Layer(NamedTuple):
    """The pixels of a box before and after something was drawn, and their 1 / distance after it."""

    drawn: Projected
    box: Rect
    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray


class SoftwareScene:
    """Collects what is drawn from a camera in a window of a size [pixels]; ``render`` draws it into an image
    and forgets it.

    The first mesh, which fills most of the view, is drawn again only if it has changed.
    """

    def __init__(self, camera: OrbitCamera, size: tuple[int, int]) -> None:
        self.camera, self.size = camera, size
        self._depth = np.zeros(size, np.float32)
        self._first: tuple[list[np.ndarray], Projected] | None = None
        self._layer: Layer | None = None
        self._clear()
        self.look()

    def _clear(self) -> None:
        self._ambient: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._lights: list[tuple] = []
        self._drawn: list[Projected] = []

    def look(self) -> None:
        """Take the camera's present place; what is added afterwards is seen from there."""
        right, up, ahead = self.camera.axes()
        half_width, half_height = self.camera.half_extent()
        self._eye, self._near = self.camera.eye(), self.camera.near_far()[0]
        self._axes = np.stack([right / half_width, up / half_height, ahead], axis=1)

    def ambient_light(self, colour) -> None:
        self._ambient = tuple(colour)

    def point_light(self, position, colour) -> None:
        self._lights.append((tuple(position), tuple(colour)))

    def mesh(self, vertices, indices: np.ndarray, normals, per_vertex_color, two_sided: bool = False) -> None:
        """Add triangles of vertex ``indices`` (3 m,); fields (n,) of vertices [mm], normals, and colours
        with or without alpha.
        """
        arrays = array_of(vertices), array_of(normals), array_of(per_vertex_color), indices
        if self._drawn:
            self._drawn.append(self._lit(*arrays, two_sided))
            return
        seen_by = self._eye, self._axes, self._ambient, np.array(self._lights), two_sided
        inputs = list(map(np.asarray, (*arrays, *seen_by)))
        if self._first is None or not all(map(np.array_equal, inputs, self._first[0])):
            self._first = [array.copy() for array in inputs], self._lit(*arrays, two_sided)
        self._drawn.append(self._first[1])

    def _lit(self, points, normals, colours, indices, two_sided: bool) -> Projected:
        lit = np.ones((len(points), 4), np.float32)
        lit[:, : colours.shape[1]] = colours
        lights = np.array([(self._eye, self._ambient), *self._lights], np.float32)
        _light(points, normals, lights, int(two_sided), lit)
        return self._projected(points), lit, np.array(indices, np.int32).reshape(-1, 3)

    def lines(self, points, width: float, color=None, per_vertex_color=None) -> None:
        """Add line segments between the points of a field (2 n,), of a width [pixels]."""
        screen = self._projected(array_of(points)).reshape(-1, 2, 3)
        screen[..., 2] *= 1.0 + LINE_NEARER
        along = screen[:, 1, :2] - screen[:, 0, :2]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1) * (width / 2 / np.maximum(length, 1e-6))
        corners = np.repeat(screen[:, :, None], 2, axis=2)
        corners[..., :2] += np.stack([across, -across], axis=1)[:, None]
        colours = np.ones((*corners.shape[:3], 4), np.float32)
        if per_vertex_color is None:
            colours[..., :3] = color
        else:
            colours[..., :3] = array_of(per_vertex_color).reshape(-1, 2, 1, 3)
        first = 4 * np.arange(len(screen))[:, None, None]
        triangles = (first + [[0, 1, 2], [2, 1, 3]]).reshape(-1, 3).astype(np.int32)
        self._drawn.append((corners.reshape(-1, 3), colours.reshape(-1, 4), triangles))

    def _projected(self, points: np.ndarray) -> np.ndarray:
        """The points (n, 3) on the screen; what is nearer than the near plane or behind has a distance of
        0.
        """
        local = (points - self._eye) @ self._axes
        near = local[:, 2] < self._near
        nearness = np.where(near, 0.0, 1.0 / np.where(near, 1.0, local[:, 2]))
        return np.column_stack([(0.5 + 0.5 * local[:, :2] * nearness[:, None]) * self.size, nearness]).astype(
            np.float32
        )

    def render(self, box: Rect, pixels: np.ndarray) -> None:
        """Draw all into a box of the window; ``pixels`` (width, height, 4) uint8 are its columns, bottom
        up.
        """
        drawn, columns = self._drawn, pixels.view(np.uint32)[..., 0]
        self._clear()
        rows = slice(self.size[1] - box.bottom, self.size[1] - box.top)
        part, depth = columns[box.left : box.right, rows], self._depth[box.left : box.right, rows]
        layer = self._layer
        if (
            layer is None
            or layer.drawn is not drawn[0]
            or layer.box != box
            or not np.array_equal(layer.before, part)
        ):
            before, depth[:] = part.copy(), 0.0
            self._draw(drawn[:1], box, columns)
            self._layer = Layer(drawn[0], box, before, part.copy(), depth.copy())
        else:
            part[:], depth[:] = layer.after, layer.depth
        if drawn[1:]:
            self._draw(drawn[1:], box, columns)

    def _draw(self, drawn: list[Projected], box: Rect, columns: np.ndarray) -> None:
        starts = np.cumsum([0, *(len(screen) for screen, _, _ in drawn)])
        screen, colours = (np.concatenate([projected[k] for projected in drawn]) for k in (0, 1))
        triangles = np.concatenate(
            [projected[2] + start for projected, start in zip(drawn, starts, strict=False)], dtype=np.int32
        )
        rows = self.size[1] - box.bottom, self.size[1] - box.top
        _draw(screen, colours, triangles, box.left, box.right, *rows, self._depth, columns)


@ti.kernel
def _light(
    points: ti.types.ndarray(ti.f32, ndim=2),
    normals: ti.types.ndarray(ti.f32, ndim=2),
    lights: ti.types.ndarray(ti.f32, ndim=3),
    two_sided: int,
    colours: ti.types.ndarray(ti.f32, ndim=2),
):
    """Multiply colours by the light on each vertex; ``lights`` (1 + n, 2, 3) are eye and ambient light,
    then places and colours.
    """
    for v in range(points.shape[0]):
        place = tm.vec3(points[v, 0], points[v, 1], points[v, 2])
        normal = tm.vec3(normals[v, 0], normals[v, 1], normals[v, 2]).normalized(1e-12)
        if two_sided and normal.dot(_row(lights, 0, 0) - place) < 0.0:
            normal = -normal
        light = _row(lights, 0, 1)
        for k in range(1, lights.shape[0]):
            towards = (_row(lights, k, 0) - place).normalized(1e-12)
            light += ti.max(normal.dot(towards), 0.0) * _row(lights, k, 1)
        for channel in ti.static(range(3)):
            colours[v, channel] *= light[channel]


@ti.func
def _row(lights: ti.template(), k, part):
    return tm.vec3(lights[k, part, 0], lights[k, part, 1], lights[k, part, 2])


@ti.kernel
def _draw(
    screen: ti.types.ndarray(ti.f32, ndim=2),
    colours: ti.types.ndarray(ti.f32, ndim=2),
    triangles: ti.types.ndarray(ti.i32, ndim=2),
    left: int,
    right: int,
    bottom: int,
    top: int,
    depth: ti.types.ndarray(ti.f32, ndim=2),
    pixels: ti.types.ndarray(ti.u32, ndim=2),
):
    """Draw triangles in their order into columns left to right - 1 and rows bottom to top - 1, where
    nearer than ``depth``.
    """
    for n in range(BANDS * TASK):
        if n % TASK == 0:
            band = n // TASK
            first, end = left + (right - left) * band // BANDS, left + (right - left) * (band + 1) // BANDS
            for t in range(triangles.shape[0]):
                corners = ti.Vector([triangles[t, 0], triangles[t, 1], triangles[t, 2]])
                x = ti.Vector([screen[corners[0], 0], screen[corners[1], 0], screen[corners[2], 0]])
                if x.min() < end and x.max() > first:
                    _draw_triangle(corners, first, end, bottom, top, screen, colours, depth, pixels)


@ti.func
def _draw_triangle(
    corners,
    first,
    end,
    bottom,
    top,
    screen: ti.template(),
    colours: ti.template(),
    depth: ti.template(),
    pixels: ti.template(),
):
    """Draw the pixels whose centres are inside: column by column, between the two edges that cross it.

    An edge that two triangles share is computed the same in both, from its left end: no pixel is drawn twice,
    and none is left out.
    """
    i, j, k = corners[0], corners[1], corners[2]
    # By their column.
    if screen[j, 0] < screen[i, 0]:
        i, j = j, i
    if screen[k, 0] < screen[i, 0]:
        i, k = k, i
    if screen[k, 0] < screen[j, 0]:
        j, k = k, j
    a = tm.vec3(screen[i, 0], screen[i, 1], screen[i, 2])
    b = tm.vec3(screen[j, 0], screen[j, 1], screen[j, 2]) - a
    c = tm.vec3(screen[k, 0], screen[k, 1], screen[k, 2]) - a
    begin = ti.max(first, ti.cast(ti.ceil(ti.max(a.x, -1.0) - 0.5), ti.i32))
    stop = ti.min(end, ti.cast(ti.ceil(ti.min(a.x + c.x, MOST_PIXELS) - 0.5), ti.i32))
    area = b.x * c.y - c.x * b.y
    is_before = screen[i, 2] > 0.0 and screen[j, 2] > 0.0 and screen[k, 2] > 0.0
    if begin < stop and area != 0.0 and is_before:
        colour = _colour(colours, i)
        to_b, to_c = _colour(colours, j) - colour, _colour(colours, k) - colour
        by_column, by_row = (to_b * c.y - to_c * b.y) / area, (to_c * b.x - to_b * c.x) / area
        z_column, z_row = (b.z * c.y - c.z * b.y) / area, (c.z * b.x - b.z * c.x) / area
        is_solid = colour.w >= 1.0 and to_b.w >= 0.0 and to_c.w >= 0.0
        for column in range(begin, stop):
            x = column + 0.5 - a.x
            whole = _crossing(screen, i, k, column + 0.5)
            part = 0.0
            if column + 0.5 < screen[j, 0]:
                part = _crossing(screen, i, j, column + 0.5)
            else:
                part = _crossing(screen, j, k, column + 0.5)
            lower, upper = ti.max(ti.min(whole, part), -1.0), ti.min(ti.max(whole, part), MOST_PIXELS)
            first_row = ti.max(bottom, ti.cast(ti.ceil(lower - 0.5), ti.i32))
            end_row = ti.min(top, ti.cast(ti.ceil(upper - 0.5), ti.i32))
            z_at, colour_at = a.z + x * z_column, colour + x * by_column
            for row in range(first_row, end_row):
                y = row + 0.5 - a.y
                z = z_at + y * z_row
                if z >= depth[column, row]:
                    depth[column, row] = z
                    drawn = colour_at + y * by_row
                    if is_solid:
                        pixels[column, row] = _packed(255.0 * drawn)
                    else:
                        under = _unpacked(pixels[column, row])
                        share = tm.clamp(drawn.w, 0.0, 1.0)
                        pixels[column, row] = _packed(
                            under + share * (255.0 * tm.clamp(drawn, 0.0, 1.0) - under)
                        )


@ti.func
def _crossing(screen: ti.template(), i, k, x):
    """The height at which an edge crosses x; point i is left of point k."""
    rise = (screen[k, 1] - screen[i, 1]) / (screen[k, 0] - screen[i, 0])
    return screen[i, 1] + (x - screen[i, 0]) * rise


@ti.func
def _colour(colours: ti.template(), i):
    return tm.vec4(colours[i, 0], colours[i, 1], colours[i, 2], colours[i, 3])


@ti.func
def _packed(colour):
    """A colour of 0 to 255, rounded, as the bytes red, green, blue and 255."""
    level = ti.cast(tm.clamp(colour, 0.0, 255.0) + 0.5, ti.u32)
    return level.x | (level.y << 8) | (level.z << 16) | (ti.cast(255, ti.u32) << 24)


@ti.func
def _unpacked(bytes):
    red, green, blue = bytes & 255, (bytes >> 8) & 255, (bytes >> 16) & 255
    return ti.cast(tm.vec4(red, green, blue, 255), ti.f32)
