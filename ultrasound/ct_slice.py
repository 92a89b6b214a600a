"""The CT slice: image plane -> deformed tetrahedra -> voxels at rest (the paper's method)."""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.kernels import kernel
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.sampled_volume import LANES, SampledVolume


class CTSlice:
    """The CT on the plane located last.

    ``ct`` is HU, ``organ`` the signed distance from the organ's surface [mm], both at rest; ``outside_hu`` is
    shown outside the organ, None for the CT there.
    """

    def __init__(
        self,
        plane: PlaneInTissue,
        ct: SampledVolume,
        organ: SampledVolume,
        outside_hu: float | None = None,
    ) -> None:
        self.plane, self.ct, self.organ = plane, ct, organ
        self.organ_alone, self.outside_hu = outside_hu is not None, outside_hu or 0.0

    def render(self, window_hu: float, level_hu: float) -> np.ndarray:
        """Grey values (rows, columns) uint8 at pixel centres, 0 to 255 over the window."""
        image = np.empty(self.plane.shape, np.uint8)
        self._window(*self.plane.grid_mm, window_hu, level_hu, image)
        return image

    @kernel
    def _window(
        self,
        pixel_mm: tm.vec2,
        first_mm: tm.vec2,
        window_hu: float,
        level_hu: float,
        image: ti.types.ndarray(ti.u8, ndim=2),
    ):
        columns = image.shape[1]
        for row, packet in ti.ndrange(image.shape[0], (columns + LANES - 1) // LANES):
            hu = self.hounsfield(row, packet * LANES, pixel_mm, first_mm, columns - 1)
            grey = ti.min(ti.max((hu - level_hu) / window_hu + 0.5, 0.0), 1.0) * 255.0 + 0.5
            for lane in ti.static(range(LANES)):
                if packet * LANES + lane < columns:
                    image[row, packet * LANES + lane] = ti.cast(grey[lane], ti.u8)

    @ti.func
    def hounsfield(self, row, first, pixel_mm, first_mm, last):
        """HU of LANES pixels of a row, whose last column is ``last``."""
        x, y, z, in_line = self.plane.rest_lanes(row, first, pixel_mm, first_mm, last)
        hu = self.ct.sample_lanes(x, y, z, in_line)
        if ti.static(self.organ_alone):
            for lane in ti.static(range(LANES)):
                column = ti.min(first + lane, last)
                if not self.in_organ(row, column, ti.Vector([x[lane], y[lane], z[lane]])):
                    hu[lane] = self.outside_hu
        return hu

    @ti.func
    def in_organ(self, row, column, rest):
        """Whether the tissue of a pixel, at a rest position [mm], is of the organ."""
        return self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0
