"""What tests ask of a CT slice beyond its image."""

import numpy as np
import taichi as ti

from sim.kernels import kernel
from ultrasound.sampled_volume import LANES
from ultrasound.scanner import Scanner

# Kernels of this module are compiled once for each scanner, those of a function at each call.


@kernel
def _mask(scanner: ti.template(), inside: ti.types.ndarray(ti.i32, ndim=2)):
    for row, column in ti.ndrange(scanner.plane.pixels, scanner.plane.pixels):
        rest = scanner.plane.rest_at(row, column, scanner.plane.grid[0], scanner.plane.grid[1])
        inside[row, column] = scanner.in_organ(row, column, rest)


@kernel
def _hounsfield(scanner: ti.template(), values: ti.types.ndarray(ti.f32, ndim=2)):
    for row, packet in ti.ndrange(scanner.plane.pixels, values.shape[1] // LANES):
        along, down = scanner.plane.grid[0], scanner.plane.grid[1]
        hu = scanner.hounsfield(row, packet * LANES, along, down, scanner.plane.pixels - 1)
        for lane in ti.static(range(LANES)):
            values[row, packet * LANES + lane] = hu[lane]


def organ_mask(scanner: Scanner) -> np.ndarray:
    """Which pixels (rows, columns) of the plane located last show the organ, bool."""
    inside = np.zeros((scanner.plane.pixels, scanner.plane.pixels), np.int32)
    _ = scanner.organ
    _mask(scanner, inside)
    return inside == 1


def hounsfield(scanner: Scanner) -> np.ndarray:
    """HU (pixels, pixels) float32 of the plane located last, before they become grey values."""
    count = scanner.plane.pixels
    values = np.zeros((count, -(-count // LANES) * LANES), np.float32)
    _ = scanner.ct, scanner.organ
    _hounsfield(scanner, values)
    return values[:, :count]
