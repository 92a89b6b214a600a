"""Speckle: scatterers as complex noise of the rest position, so that it moves and deforms with the tissue.

Many scatterers per resolution cell, much smaller than the wavelength, give circular complex Gaussian echoes
(Goodman 1975), whose correlation is that of the pulse and of the beam (Wagner 1983). So the noise has the
pulse's length built in along the image plane, and the beam's correlation length across it. The phase of the
carrier, which does not affect the magnitude, is left out.

Across the plane the noise is longer than along it. Its long axis has one of many fixed directions, two of
which are mixed where the plane turns from one to the next; and one of the fixed lengths ELEVATION_SD_MM.
So speckle depends on nothing but the tissue's rest position and on where the plane lies: a sweep that comes
back shows it again.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import field_of

SIZE_BITS = 6
SIZE = 1 << SIZE_BITS
# Noise entries per standard deviation of the correlation kernel.
PITCHES = 1.25
# Correlation of neighbouring entries.
NEXT = float(np.exp(-1 / (4 * PITCHES**2)))
SEED = 20130629
# Many points are exactly on the planes through 0, where rounding would choose the cell: cells begin
# elsewhere.
CELL_OFFSET = 0.37
# Real and imaginary part share one 32-bit word, so that the block fits into the cache.
UNIT = 1 / 4096
# Lengths across the image plane, in steps of a quarter of an octave.
SHORTEST_SD_MM, LENGTH_STEP, LEVELS = 0.05, 2.0**0.25, 29
ELEVATION_SD_MM = SHORTEST_SD_MM * LENGTH_STEP ** np.arange(LEVELS)
# Directions of the long axis: so many each way on a face of a cube. Two directions, or two lengths, are mixed
# in this part of the way between them: elsewhere there is one noise to compute.
DIRECTIONS, MIXED = 23, 0.2
QUARTER = float(np.pi / 4)
# Two directions each way on the cube's face, two lengths.
COMPONENTS, LEAST_WEIGHT = 8, 1e-3


def noise_block() -> np.ndarray:
    """Periodic complex Gaussian noise (SIZE, SIZE, SIZE, 2) float32 of unit mean square, the same on every
    machine.

    White noise convolved with a Gaussian of PITCHES entries SD: entries at a distance d correlate by exp(-d^2
    / (4 PITCHES^2)).
    """
    white = np.random.default_rng(SEED).standard_normal((2, SIZE, SIZE, SIZE))
    frequency = 2 * np.pi * np.fft.fftfreq(SIZE)
    kernel = np.exp(-0.5 * (PITCHES * frequency) ** 2)
    spectrum = np.fft.fftn(white, axes=(1, 2, 3)) * (kernel[:, None, None] * kernel[:, None] * kernel)
    noise = np.fft.ifftn(spectrum, axes=(1, 2, 3)).real
    noise /= np.sqrt((noise**2).sum(axis=0).mean())
    return np.ascontiguousarray(np.moveaxis(noise, 0, -1), np.float32)


def elevation_levels(sd_mm: np.ndarray) -> np.ndarray:
    """For correlation SDs (n,) [mm], index of the shorter length, its weight, that of the next one, and the
    shorter length: (n, 4) float32.

    The length is that of the nearest index, up to 9 % off.
    """
    at = np.clip(np.log(sd_mm / SHORTEST_SD_MM) / np.log(LENGTH_STEP), 0, LEVELS - 1.001)
    level = np.floor(at)
    share = np.clip((at - level - 0.5) / MIXED + 0.5, 0, 1)
    shorter = SHORTEST_SD_MM * LENGTH_STEP**level
    return np.column_stack([level, np.sqrt(1 - share), np.sqrt(share), shorter]).astype(np.float32)


@ti.dataclass
class LongAxis:
    """Directions of the long axis to mix: face of the cube (0 to 2), indices on it, steps (-1 or 1) to the
    next, and their shares.
    """

    face: ti.i32
    index: ti.math.ivec2
    step: ti.math.ivec2
    share: tm.vec2


class Speckle:
    """The noise block on the device. Each block of space holds it, shifted by a hash of the block, so that it
    does not repeat.

    Speckle of unit mean square is the sum of COMPONENTS noises, each with its ``weight``; most have none.
    """

    def __init__(self) -> None:
        real, imaginary = np.rint(noise_block().reshape(-1, 2).T / UNIT).astype(np.int32)
        self.noise = field_of((imaginary << 16) | (real & 0xFFFF))

    @ti.func
    def entry(self, i, j, k):
        """The noise (2,), real and imaginary, at an entry of the block."""
        size = ti.static(SIZE - 1)
        word = self.noise[((((i & size) << SIZE_BITS) | (j & size)) << SIZE_BITS) | (k & size)]
        return UNIT * tm.vec2((word << 16) >> 16, word >> 16)

    @ti.func
    def at(self, place, key):
        """The noise (2,), of unit mean square, at a place in entries: interpolated along its last axis, the
        long one.
        """
        at = place + CELL_OFFSET
        cell = ti.floor(at, ti.i32)
        t = at.z - cell.z
        block = cell >> SIZE_BITS
        mixed = (block.x * 73856093) ^ (block.y * 19349663) ^ (block.z * 83492791) ^ key
        mixed = (mixed ^ ((mixed >> 15) & 0x1FFFF)) * 0x2C1B3C6D
        local = cell + ti.Vector([mixed >> 2, mixed >> 10, mixed >> 18])
        low, high = self.entry(local.x, local.y, local.z), self.entry(local.x, local.y, local.z + 1)
        # Restores unit mean square: the first terms of 1 / sqrt(1 - lost), to 1e-4.
        lost = 2.0 * (1.0 - NEXT) * t * (1.0 - t)
        return (1.0 + 0.5 * lost + 0.375 * lost * lost) * tm.mix(low, high, t)

    @ti.func
    def long_axis(self, across):
        """The LongAxis for a vector across the image plane."""
        size = ti.abs(across)
        face, x, y, top = 2, across.x, across.y, across.z
        if size.x > size.y and size.x > size.z:
            face, x, y, top = 0, across.y, across.z, across.x
        elif size.y > size.z:
            face, x, y, top = 1, across.z, across.x, across.y
        at = tm.vec2(ti.atan2(x / top, 1.0), ti.atan2(y / top, 1.0)) * (DIRECTIONS / 2.0 / QUARTER)
        index = ti.round(at, ti.i32)
        off = at - index
        step = ti.select(off < 0.0, ti.Vector([-1, -1]), ti.Vector([1, 1]))
        share = tm.clamp((ti.abs(off) - 0.5 * (1.0 - MIXED)) / MIXED, 0.0, 0.5)
        return LongAxis(face, index, step, share)  # type: ignore[call-arg]

    @ti.func
    def weight(self, component, axis, lengths):
        """The weight of one of the COMPONENTS noises; ``lengths`` is of ``elevation_levels``."""
        other = ti.Vector([(component >> 2) & 1, (component >> 1) & 1])
        share = ti.select(other == 1, axis.share, 1.0 - axis.share)
        return ti.sqrt(share.x * share.y) * ti.select((component & 1) == 1, lengths.z, lengths.y)

    @ti.func
    def component(self, component, axis, lengths, sd_mm, look):
        """Key and matrix (3, 3) from the rest position [mm] to entries of one of the COMPONENTS noises.

        ``sd_mm`` is the length along the image plane. Another ``look``, of an image steered by another angle,
        has other noise.
        """
        other, longer = ti.Vector([(component >> 2) & 1, (component >> 1) & 1]), component & 1
        index = axis.index + other * axis.step
        level = ti.cast(lengths.x, ti.i32) + longer
        matrix = self.axes(axis.face, index)
        longer_mm = lengths.w * ti.select(longer == 1, LENGTH_STEP, 1.0)
        fine, coarse = PITCHES / sd_mm, PITCHES / longer_mm
        for column in ti.static(range(3)):
            matrix[0, column] *= fine
            matrix[1, column] *= fine
            matrix[2, column] *= coarse
        key = (((look * 64 + index.x) * 64 + index.y) * 4 + axis.face) * 32 + level
        return key * 40503, matrix

    @ti.func
    def axes(self, face, index):
        """The rotation (3, 3) from rest axes to those of a direction, the long one last."""
        slope = ti.tan(ti.cast(index, ti.f32) * (2.0 * QUARTER / DIRECTIONS))
        long = tm.normalize(tm.vec3(slope.x, slope.y, 1.0))
        first = tm.normalize(tm.vec3(1.0, 0.0, -slope.x))
        second = tm.cross(long, first)
        turned = ti.Matrix.cols([tm.vec3(first[k], second[k], long[k]) for k in ti.static(range(3))])
        x, y, top = turned[:, 0], turned[:, 1], turned[:, 2]
        if face == 0:
            turned = ti.Matrix.cols([top, x, y])
        elif face == 1:
            turned = ti.Matrix.cols([y, top, x])
        return turned
