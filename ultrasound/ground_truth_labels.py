"""What each pixel of a picture is: outside, organ or tumour, or a bead in it. The truth beside a sweep."""

from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import field_of
from ultrasound.image_plane import Picture, PlaneInTissue
from ultrasound.sampled_volume import SampledVolume
from ultrasound.sweep import PixelLabel

MOST_BEADS = 255 // PixelLabel.BEAD


@ti.data_oriented
class GroundTruthLabels:
    """GroundTruthLabels of the plane that was taken last, by where its tissue was at rest.

    ``organ`` and ``tumour`` are signed distances [mm], negative inside; ``beads`` (n, 3) are middles of balls of a radius [mm].
    """

    def __init__(
        self,
        plane: PlaneInTissue,
        organ: SampledVolume,
        tumour: SampledVolume | None = None,
        beads: np.ndarray | None = None,
        radius_mm: float = 2.0,
    ) -> None:
        self.plane, self.organ, self.radius_mm = plane, organ, radius_mm
        self.tumour: Any = tumour
        self.has_tumour = tumour is not None
        self.beads = 0 if beads is None else len(beads)
        if self.beads > MOST_BEADS:
            raise ValueError(f"{self.beads} beads: a pixel has room for {MOST_BEADS}")
        if beads is not None:
            self.bead = field_of(np.asarray(beads, float), 1)

    def render(self) -> np.ndarray:
        """GroundTruthLabels (pixels, pixels) uint8."""
        picture = np.empty((self.plane.pixels, self.plane.pixels), np.uint8)
        self._render(self.plane.pixel_mm, self.plane.first_mm, picture)
        return picture

    @ti.kernel
    def _render(self, pixel_mm: tm.vec2, first_mm: tm.vec2, picture: Picture):
        for row, column in ti.ndrange(self.plane.pixels, self.plane.pixels):
            rest = self.plane.rest_at(row, column, pixel_mm, first_mm)
            mark = ti.cast(PixelLabel.OUTSIDE, ti.i32)
            if self.plane.is_tissue(row, column):
                if self.organ.sample(rest) < 0.0:
                    mark = PixelLabel.ORGAN
                if ti.static(self.has_tumour):
                    if self.tumour.sample(rest) < 0.0:
                        mark = PixelLabel.TUMOUR
                if ti.static(self.beads > 0):
                    for k in range(self.beads):
                        if (rest - self.bead[k]).norm_sqr() < self.radius_mm**2:
                            mark = mark % PixelLabel.BEAD + PixelLabel.BEAD * (k + 1)
            picture[row, column] = ti.cast(mark, ti.u8)
