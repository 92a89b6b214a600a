"""What tests ask of a CT slice beyond its image."""

import numpy as np
import taichi as ti

from sim.kernels import kernel
from ultrasound.ct_slice import CTSlice
from ultrasound.sampled_volume import LANES

# Kernels of this module are compiled once for each slice, those of a function at each call.


@kernel
def _mask(cut: ti.template(), inside: ti.types.ndarray(ti.i32, ndim=2)):
    for row, column in ti.ndrange(cut.plane.pixels, cut.plane.pixels):
        rest = cut.plane.rest_at(row, column, cut.plane.grid[0], cut.plane.grid[1])
        inside[row, column] = cut.in_organ(row, column, rest)


@kernel
def _hounsfield(cut: ti.template(), values: ti.types.ndarray(ti.f32, ndim=2)):
    for row, packet in ti.ndrange(cut.plane.pixels, values.shape[1] // LANES):
        along, down = cut.plane.grid[0], cut.plane.grid[1]
        hu = cut.hounsfield(row, packet * LANES, along, down, cut.plane.pixels - 1)
        for lane in ti.static(range(LANES)):
            values[row, packet * LANES + lane] = hu[lane]


def organ_mask(cut: CTSlice) -> np.ndarray:
    """Which pixels (rows, columns) of the plane located last show the organ, bool."""
    inside = np.zeros((cut.plane.pixels, cut.plane.pixels), np.int32)
    _mask(cut, inside)
    return inside == 1


def hounsfield(cut: CTSlice) -> np.ndarray:
    """HU (pixels, pixels) float32 of the plane located last, before they become grey values."""
    count = cut.plane.pixels
    values = np.zeros((count, -(-count // LANES) * LANES), np.float32)
    _hounsfield(cut, values)
    return values[:, :count]
