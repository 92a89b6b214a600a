"""What tests ask of a slice beyond its picture."""

import numpy as np
import taichi as ti
import taichi.math as tm

from ultrasound.ct_slice import CtSlice


def organ_mask(cut: CtSlice) -> np.ndarray:
    """Which pixels (rows, columns) of the plane taken last show the organ, bool."""
    inside = np.zeros((cut.plane.pixels, cut.plane.pixels), np.int32)

    @ti.kernel
    def ask(pixel_mm: tm.vec2, first_mm: tm.vec2, inside: ti.types.ndarray(ti.i32, ndim=2)):
        for row, column in ti.ndrange(cut.plane.pixels, cut.plane.pixels):
            rest = cut.plane.rest_at(row, column, pixel_mm, first_mm)
            inside[row, column] = cut.in_organ(row, column, rest)

    ask(cut.plane.pixel_mm, cut.plane.first_mm, inside)
    return inside == 1
