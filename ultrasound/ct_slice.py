"""The CT slice on the image plane: image plane -> deformed tetrahedra -> voxels at rest (the paper's method)."""

import numpy as np
import taichi as ti
import taichi.math as tm

from ultrasound.image_plane import LANES, Picture, PlaneInTissue
from ultrasound.sampled_volume import AIR_HU, SampledVolume

# HU outside the organ; the background is the CT itself.
OUTSIDE_HU = {"background": 0.0, "gel": 0.0, "air": AIR_HU}


@ti.data_oriented
class CtSlice:
    """The CT on an image plane through the deformed body.

    ``ct`` [HU] and ``organ``, the signed distance from its surface [mm], negative inside, are volumes in the body's
    rest frame. ``outside`` is what is shown outside the organ: ``background``, the CT around it, which deforms with the organ as
    far as the embedding reaches; ``gel`` (0 HU); ``air`` (-1000 HU).
    """

    def __init__(
        self, ct: SampledVolume, organ: SampledVolume, plane: PlaneInTissue, outside: str = "background"
    ) -> None:
        if outside not in OUTSIDE_HU:
            raise ValueError(f"outside is {outside!r}: expected one of {', '.join(OUTSIDE_HU)}")
        self.ct = ct
        self.organ = organ
        self.plane = plane
        self.show_background = outside == "background"
        self.outside_hu = OUTSIDE_HU[outside]
        self.packets = (plane.pixels + LANES - 1) // LANES

    def render(self, window_hu: float, level_hu: float) -> np.ndarray:
        """Return grey values (pixels, pixels) uint8, 0 to 255 over the window, of the plane located last, at pixel centres."""
        picture = np.empty((self.plane.pixels, self.plane.pixels), np.uint8)
        self._render(self.plane.pixel_mm, self.plane.first_mm, window_hu, level_hu, picture)
        return picture

    def hounsfield(self) -> np.ndarray:
        """Return HU (pixels, pixels) float32 of the plane located last."""
        values = np.empty((self.plane.pixels, self.plane.pixels), np.float32)
        self._hounsfield(self.plane.pixel_mm, self.plane.first_mm, values)
        return values

    @ti.kernel
    def _render(
        self, pixel_mm: tm.vec2, first_mm: tm.vec2, window_hu: float, level_hu: float, picture: Picture
    ):
        for row, packet in ti.ndrange(self.plane.pixels, self.packets):
            hu = self.sample(row, packet * LANES, pixel_mm, first_mm)
            grey = ti.min(ti.max((hu - level_hu) / window_hu + 0.5, 0.0), 1.0) * 255.0 + 0.5
            for lane in ti.static(range(LANES)):
                if packet * LANES + lane < self.plane.pixels:
                    picture[row, packet * LANES + lane] = ti.cast(grey[lane], ti.u8)

    @ti.kernel
    def _hounsfield(self, pixel_mm: tm.vec2, first_mm: tm.vec2, values: ti.types.ndarray(ti.f32, ndim=2)):
        for row, packet in ti.ndrange(self.plane.pixels, self.packets):
            hu = self.sample(row, packet * LANES, pixel_mm, first_mm)
            for lane in ti.static(range(LANES)):
                if packet * LANES + lane < self.plane.pixels:
                    values[row, packet * LANES + lane] = hu[lane]

    @ti.func
    def sample(self, row, first, pixel_mm, first_mm):
        """Return HU of LANES pixels of a row."""
        x, y, z, in_line = self.plane.rest_lanes(row, first, pixel_mm, first_mm)
        hu = self.ct.sample_lanes(x, y, z, in_line)
        if ti.static(not self.show_background):
            for lane in ti.static(range(LANES)):
                column = ti.min(first + lane, self.plane.pixels - 1)
                if not self.in_organ(row, column, tm.vec3(x[lane], y[lane], z[lane])):
                    hu[lane] = self.outside_hu
        return hu

    @ti.func
    def in_organ(self, row, column, rest):
        """Whether the tissue of a pixel, at a rest position [mm], is of the organ."""
        return self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0
