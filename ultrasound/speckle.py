"""Speckle: scatterers as complex noise of the rest position, so that it moves and deforms with the tissue.

Many scatterers per resolution cell, much smaller than the wavelength, give circular complex Gaussian echoes (Goodman 1975), whose
correlation is that of the pulse. So the noise has the axial width of the point-spread function built in. The phase of the carrier,
which does not affect the magnitude, is left out: samples 0.1 mm apart would not resolve it.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import field_of

SIZE_BITS = 6
SIZE = 1 << SIZE_BITS
# Noise entries per standard deviation of the correlation kernel.
PITCHES = 1.25
SEED = 20130629
# Many points are exactly on the planes through 0, where rounding would choose the cell: cells begin elsewhere.
CELL_OFFSET = 0.37
# Real and imaginary part share one 32-bit word, so that the block fits into the cache.
UNIT = 1 / 4096


def noise_block() -> np.ndarray:
    """Return periodic complex Gaussian noise (SIZE, SIZE, SIZE, 2) float32 of unit mean square, the same on every machine.

    White noise convolved with a Gaussian of PITCHES entries SD: entries at a distance d correlate by exp(-d^2 / (4 PITCHES^2)).
    """
    white = np.random.default_rng(SEED).standard_normal((2, SIZE, SIZE, SIZE))
    frequency = 2 * np.pi * np.fft.fftfreq(SIZE)
    kernel = np.exp(-0.5 * (PITCHES * frequency) ** 2)
    spectrum = np.fft.fftn(white, axes=(1, 2, 3)) * (kernel[:, None, None] * kernel[:, None] * kernel)
    noise = np.fft.ifftn(spectrum, axes=(1, 2, 3)).real
    noise /= np.sqrt((noise**2).sum(axis=0).mean())
    return np.ascontiguousarray(np.moveaxis(noise, 0, -1), np.float32)


@ti.data_oriented
class Speckle:
    """The noise block on the device. Each block of space holds it, shifted by a hash of the block, so that it does not repeat."""

    def __init__(self) -> None:
        real, imaginary = np.rint(noise_block().reshape(-1, 2).T / UNIT).astype(np.int32)
        self.noise = field_of((imaginary << 16) | (real & 0xFFFF))

    @ti.func
    def at(self, rest, sd_mm):
        """Return the noise (2,), real and imaginary, at a rest position [mm], correlated over ``sd_mm``."""
        cell = ti.floor(rest * (PITCHES / sd_mm) + CELL_OFFSET, ti.i32)
        block = cell >> SIZE_BITS
        key = (block.x * 73856093) ^ (block.y * 19349663) ^ (block.z * 83492791)
        key = (key ^ ((key >> 15) & 0x1FFFF)) * 0x2C1B3C6D
        shift = ti.Vector([key >> 2, key >> 10, key >> 18])
        local = (cell + shift) & (SIZE - 1)
        word = self.noise[(((local.x << SIZE_BITS) | local.y) << SIZE_BITS) | local.z]
        return UNIT * tm.vec2((word << 16) >> 16, word >> 16)
