"""The CT slice that the transducer would see: image plane -> deformed tetrahedra -> rest voxels (the paper's way)."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.embedding import NOWHERE, Embedding
from ultrasound.volume import AIR_HU, Volume

OUTSIDES = ("background", "gel", "air")
OUTSIDE_HU = {"background": 0.0, "gel": 0.0, "air": AIR_HU}


@dataclass(frozen=True)
class ImagePlane:
    """The part of the transducer's plane that is drawn.

    ``width_mm`` along the transducer's x, ``depth_mm`` along its -z, which starts at its face.
    ``world_from_plane`` (4, 4): x to the marked side, y down into the tissue [mm].
    """

    world_from_plane: np.ndarray
    width_mm: float
    depth_mm: float


@ti.data_oriented
class Slice:
    """HU (rows, columns) of an image plane through the deformed body, and which pixels show the organ.

    ``ct`` [HU] and ``organ``, the signed distance from its surface [mm], negative inside, are volumes in the body's
    rest frame. ``outside`` is what the picture shows of all that is not the organ: ``background``, the CT around it,
    which gives way to the organ as far as the embedding reaches; ``gel`` (0 HU); ``air`` (-1000 HU).
    """

    def __init__(
        self, ct: Volume, organ: Volume, embedding: Embedding, pixels: int = 512, outside: str = "background"
    ) -> None:
        if outside not in OUTSIDES:
            raise ValueError(f"outside is {outside!r}: expected one of {', '.join(OUTSIDES)}")
        self.ct = ct
        self.organ = organ
        self.embedding = embedding
        self.show_background = outside == "background"
        self.outside_hu = OUTSIDE_HU[outside]
        self.owner = ti.field(ti.i32, (pixels, pixels))
        self.hu = ti.field(ti.f32, (pixels, pixels))
        self.in_organ = ti.field(ti.i32, (pixels, pixels))
        self.grey = ti.field(ti.u8, (pixels, pixels))
        self.pixels = pixels

    def render(self, plane: ImagePlane, window_hu: float, level_hu: float) -> None:
        """Fill ``hu``, ``in_organ`` and ``grey`` (0 to 255 over the window); pixels are sampled at their centres."""
        pixel = np.array([plane.width_mm, plane.depth_mm]) / self.pixels
        first = np.array([-plane.width_mm / 2, 0.0]) + pixel / 2
        world = _matrix(plane.world_from_plane)
        inverse = _matrix(np.linalg.inv(plane.world_from_plane))
        pixel_mm, first_mm = ti.Vector(pixel.tolist()), ti.Vector(first.tolist())
        self.embedding.locate_on_plane(inverse, pixel_mm, first_mm, self.owner)
        self._sample(world, pixel_mm, first_mm, window_hu, level_hu)

    @ti.kernel
    def _sample(
        self, world: tm.mat4, pixel_mm: tm.vec2, first_mm: tm.vec2, window_hu: float, level_hu: float
    ):
        for row, column in self.hu:
            p = (
                world @ tm.vec4(first_mm.x + column * pixel_mm.x, first_mm.y + row * pixel_mm.y, 0.0, 1.0)
            ).xyz
            t = self.owner[row, column]
            rest = p
            if t != NOWHERE:
                rest = self.embedding.rest_point(t, p)
            inside = ti.cast(t != NOWHERE and self.organ.sample(rest) <= 0.0, ti.i32)
            hu = self.outside_hu
            if ti.static(self.show_background) or inside == 1:
                hu = self.ct.sample(rest)
            self.hu[row, column] = hu
            self.in_organ[row, column] = inside
            bright = (hu - level_hu) / window_hu + 0.5
            self.grey[row, column] = ti.cast(tm.clamp(bright, 0.0, 1.0) * 255.0 + 0.5, ti.u8)


def _matrix(values: np.ndarray) -> ti.Matrix:
    return ti.Matrix(np.asarray(values, float).tolist())
