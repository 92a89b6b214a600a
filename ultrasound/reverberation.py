"""Reverberation: echoes that arrive later because sound went to and fro.

Behind gas, the tissue in front of it is seen again, weaker, as sound returns from it by way of the gas (dirty
shadow); bubbles ring on for a long time (ring-down). A clip of metal sends sound to and fro within itself
(comet tail). The face of the array reflects what returns to it, so that strong interfaces are repeated; and
its own vibration takes a while to die down (near field). The strengths are estimates, after images of
atlases; the vibration in air is that of a recorded array.
"""

import numpy as np
import taichi as ti

from sim.fields import zeros
from sim.kernels import kernel
from sim.taichi_internals import TASK
from ultrasound.probe import Probe
from ultrasound.propagation import Propagation, speed_ratio
from ultrasound.pulse import DB_OF_NEPER

# Tissue of less impedance is gas, of more it is metal [MRayl].
GAS_MRAYL, METAL_MRAYL = 0.3, 15.0
# Amplitude that the face of the array reflects. An interface that returns less than the second amplitude is
# not repeated visibly.
FACE, LEAST_REPEATED = 0.25, 0.01
# Amplitude of tissue that is seen by way of gas.
BY_GAS = 0.35
# Bubbles: share of the surface of gas, distance, amplitude and fall.
BUBBLE_SHARE, BUBBLE_MM, BUBBLE_AMPLITUDE, BUBBLE_FALL_DB_MM = 0.08, 1.5, 0.06, 0.5
# Bubbles ring where the beam meets the gas nearly squarely: where a third of it is returned as by a mirror,
# or more.
BUBBLE_SQUARELY = 3.0
# A clip is taken to be at least so thick [mm]; it may be thinner than the distance of tissue samples.
LEAST_METAL_MM = 0.8
# Vibration of the array in contact, and in air: the length in wavelengths over which it falls to 1 / e; and
# how much stronger it is in air [dB]: estimates, as no recording has both.
FALL, MORE_IN_AIR_DB = 1.5, 6.0
# In air, fitted to a linear array in air (PLUS's UltrasonixLinearRfData; study scanner): that length, the
# thickness of the lens between whose faces it bands, in wavelengths, and half of the depth of these bands.
FALL_IN_AIR, LENS, BANDS = 9.4, 5.3, 0.27


class Reverberation:
    """Amplitude of scatter ``level`` (scanlines, samples) that reverberation adds to that of ``sound``.

    ``path`` [Np/MHz] is that of ``sound`` or, behind gas, that of what reached the gas.
    """

    def __init__(self, sound: Propagation) -> None:
        self.sound = sound
        self.level, self.path = (zeros(sound.lines, sound.most) for _ in range(2))

    @kernel
    def run(self, count: int, step_mm: float):
        """Set ``level`` and ``path`` after ``sound`` ran."""
        for n in range(self.sound.lines * TASK):
            if n % TASK == 0:
                self.run_scanline(n // TASK, count, step_mm)

    @ti.func
    def run_scanline(self, line, count, step_mm):
        for k in range(count):
            self.level[line, k] = 0.0
            self.path[line, k] = self.sound.path[line, k]
        gas = 0
        for k in range(1, count):
            echo, behind = self.sound.echo[line, k], self.sound.tissue[line, k].x
            if gas == 0 and echo.z > 0.0 and behind > 1e-6:
                if behind < GAS_MRAYL:
                    gas = k
                    self.add_behind_gas(line, k, ti.max(ti.cast(echo.w, ti.i32), 1), count, step_mm)
                elif behind > METAL_MRAYL and self.before(line, k) < METAL_MRAYL:
                    self.add_comet_tail(line, k, count, step_mm)

    @ti.func
    def add_behind_gas(self, line, gas, front, count, step_mm):
        """Add what is seen by way of gas: the tissue in front, from the surface of the gas back to the
        face, then forth again.
        """
        arrived, path = self.sound.amplitude[line, front], self.sound.path[line, front]
        squarely = ti.min(BUBBLE_SQUARELY * ti.abs(self.sound.echo[line, gas].x), 1.0)
        bubble = BUBBLE_AMPLITUDE * arrived * squarely * self.has_bubble(self.sound.rest[line, front])
        for k in range(gas, count):
            turns, further = (k - gas) // front, (k - gas) % front
            # Each second turn begins at the face, which sound has reached by way of the gas.
            seen = BY_GAS * (FACE * arrived) ** ((turns + 1) // 2)
            there = further
            if turns % 2 == 0:
                there = front - further
                # From the gas to the tissue there and back, and from the gas to the face.
                lost = arrived / ti.max(self.sound.amplitude[line, there], 1e-9)
                lost *= self.sound.build_up[there] / self.sound.build_up[front]
                seen *= arrived * ti.min(lost, 1.0)
            else:
                seen *= self.sound.amplitude[line, there]
            seen *= self.sound.tissue[line, there].z
            fall_db = BUBBLE_FALL_DB_MM * (k - gas) * step_mm
            self.level[line, k] += seen + bubble * ti.exp(-fall_db / DB_OF_NEPER)
            self.path[line, k] = path

    @ti.func
    def has_bubble(self, rest):
        """1 at some places of the tissue, 0 elsewhere."""
        cell = ti.floor(rest / BUBBLE_MM, ti.i32)
        mixed = (cell.x * 73856093) ^ (cell.y * 19349663) ^ (cell.z * 83492791)
        mixed = (mixed ^ ((mixed >> 15) & 0x1FFFF)) * 0x2C1B3C6D
        return ti.select(((mixed >> 8) & 0xFFFF) < BUBBLE_SHARE * 65536, 1.0, 0.0)

    @ti.func
    def before(self, line, k):
        """The impedance [MRayl] in front of the interface whose echo is at a sample."""
        return self.sound.tissue[line, ti.cast(self.sound.echo[line, k].w, ti.i32)].x

    @ti.func
    def add_comet_tail(self, line, metal, count, step_mm):
        """Add the echoes within metal: at each of its faces a part of the sound leaves it."""
        echo, impedance = self.sound.echo[line, metal], self.sound.tissue[line, metal].x
        inside = 0
        while metal + inside < count and self.sound.tissue[line, metal + inside].x > METAL_MRAYL:
            inside += 1
        ratio = speed_ratio(impedance)
        thickness = ti.max(inside * step_mm * ratio, LEAST_METAL_MM)
        before = self.before(line, metal)
        reflection = (impedance - before) / (impedance + before)
        fall_db_mm = -2.0 * DB_OF_NEPER * ti.log(reflection) / (thickness / ratio)
        front = ti.max(metal - 1, 0)
        start = self.sound.amplitude[line, ti.min(ti.cast(echo.w, ti.i32), front)]
        start *= (1.0 - reflection**2) * ti.sqrt(echo.x**2 + echo.y**2)
        for k in range(metal, count):
            self.level[line, k] += start * ti.exp(-fall_db_mm * (k - metal) * step_mm / DB_OF_NEPER)


def ringing(probe: Probe) -> np.ndarray:
    """The amplitude of the array's own vibration at each sample, in air and in contact, (2, samples)
    float32.
    """
    depth = (np.arange(probe.number_of_samples_per_scanline) + 0.5) * probe.sample_mm / probe.wavelength_mm
    start = 10 ** (probe.ringing_db / 20)
    bands = 1 - BANDS + BANDS * np.cos(2 * np.pi * depth / LENS)
    in_air = 10 ** (MORE_IN_AIR_DB / 20) * np.exp(-depth / FALL_IN_AIR) * bands
    # Harmonics are not of the frequency at which the array vibrates.
    share = 0.1 if probe.harmonics else 1.0
    return (share * start * np.stack([in_air, np.exp(-depth / FALL)])).astype(np.float32)
