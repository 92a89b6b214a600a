"""What tests ask of a CT slice beyond its image."""

import numpy as np
import taichi as ti

from ultrasound.sampled_volume import LANES
from ultrasound.scanner import Scanner


def organ_mask(scanner: Scanner) -> np.ndarray:
    """Which pixels (rows, columns) of the plane located last show the organ, bool."""
    plane = scanner.plane
    inside = np.zeros((plane.pixels, plane.pixels), np.int32)
    _ = scanner.organ

    @ti.kernel
    def ask(inside: ti.types.ndarray(ti.i32, ndim=2)):
        for row, column in ti.ndrange(plane.pixels, plane.pixels):
            rest = plane.rest_at(row, column, plane.grid[0], plane.grid[1])
            inside[row, column] = scanner.in_organ(row, column, rest)

    ask(inside)
    return inside == 1


def hounsfield(scanner: Scanner) -> np.ndarray:
    """HU (pixels, pixels) float32 of the plane located last, before they become grey values."""
    plane, count = scanner.plane, scanner.plane.pixels
    packets = -(-count // LANES)
    values = np.zeros((count, packets * LANES), np.float32)
    _ = scanner.ct, scanner.organ

    @ti.kernel
    def ask(values: ti.types.ndarray(ti.f32, ndim=2)):
        for row, packet in ti.ndrange(count, packets):
            hu = scanner.hounsfield(row, packet * LANES, plane.grid[0], plane.grid[1], count - 1)
            for lane in ti.static(range(LANES)):
                values[row, packet * LANES + lane] = hu[lane]

    ask(values)
    return values[:, :count]
