"""The CT slice that the transducer would see: image plane -> deformed tetrahedra -> rest voxels (the paper's way)."""

import numpy as np
import taichi as ti
import taichi.math as tm

from ultrasound.plane import Picture, PlaneInTissue
from ultrasound.volume import AIR_HU, LANES, Lanes, Volume

OUTSIDES = ("background", "gel", "air")
OUTSIDE_HU = {"background": 0.0, "gel": 0.0, "air": AIR_HU}


@ti.data_oriented
class Slice:
    """The CT on an image plane through the deformed body.

    ``ct`` [HU] and ``organ``, the signed distance from its surface [mm], negative inside, are volumes in the body's
    rest frame. ``outside`` is what the picture shows of all that is not the organ: ``background``, the CT around it,
    which gives way to the organ as far as the embedding reaches; ``gel`` (0 HU); ``air`` (-1000 HU).
    """

    def __init__(self, ct: Volume, organ: Volume, plane: PlaneInTissue, outside: str = "background") -> None:
        if outside not in OUTSIDES:
            raise ValueError(f"outside is {outside!r}: expected one of {', '.join(OUTSIDES)}")
        self.ct = ct
        self.organ = organ
        self.plane = plane
        self.show_background = outside == "background"
        self.outside_hu = OUTSIDE_HU[outside]
        self.hu = ti.field(ti.f32, (plane.pixels, plane.pixels))

    def render(self, window_hu: float, level_hu: float) -> np.ndarray:
        """Grey values (pixels, pixels) uint8, 0 to 255 over the window, of the plane that was taken last; ``hu`` is what they show.

        Pixels are sampled at their centres.
        """
        picture = np.empty((self.plane.pixels, self.plane.pixels), np.uint8)
        self._sample(self.plane.pixel_mm, self.plane.first_mm, window_hu, level_hu, picture)
        return picture

    @ti.kernel
    def _sample(
        self, pixel_mm: tm.vec2, first_mm: tm.vec2, window_hu: float, level_hu: float, picture: Picture
    ):
        last = self.plane.pixels - 1
        for row, packet in ti.ndrange(self.plane.pixels, (last + LANES) // LANES):
            first = packet * LANES
            x, y, z = Lanes(0.0), Lanes(0.0), Lanes(0.0)
            for lane in ti.static(range(LANES)):
                rest = self.plane.rest_at(row, ti.min(first + lane, last), pixel_mm, first_mm)
                x[lane], y[lane], z[lane] = rest.x, rest.y, rest.z
            hu = self.ct.sample_lanes(x, y, z)
            if ti.static(not self.show_background):
                for lane in ti.static(range(LANES)):
                    rest = tm.vec3(x[lane], y[lane], z[lane])
                    if not self.in_organ(row, ti.min(first + lane, last), rest):
                        hu[lane] = self.outside_hu
            grey = ti.min(ti.max((hu - level_hu) / window_hu + 0.5, 0.0), 1.0) * 255.0 + 0.5
            for lane in ti.static(range(LANES)):
                if first + lane <= last:
                    self.hu[row, first + lane] = hu[lane]
                    picture[row, first + lane] = ti.cast(grey[lane], ti.u8)

    @ti.func
    def in_organ(self, row, column, rest):
        """Whether the tissue of a pixel, at a place at rest [mm], is the organ's."""
        return self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0
