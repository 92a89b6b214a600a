"""The echo of an interface between two tissues: how strong it is, and how it depends on the angle of
incidence.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti
import taichi.math as tm

# A smaller relative change of impedance between two samples is no interface.
MIN_REFLECTION = 3e-4
# An interface that reflects more of the amplitude than this is that of a stone, a bone or gas.
HARD = 0.3
# A weaker interface is taken to be noise, and does not refract. Beyond this angle of incidence [rad]
# refraction is as at it.
LEAST_REFRACTING, MOST_REFRACTED = 0.008, 1.25
# Edge waves of the aperture: amplitude of a smooth interface that reflects just past the aperture, and its
# fall [1 / half angle].
# Fitted to SIMUS (``study echo``).
EDGE, EDGE_FALL = 0.08, 2.75


@dataclass(frozen=True)
class Surface:
    """The surface of tissue interfaces: SD of its height, SD of its slope, and the amplitude, relative to a
    smooth surface, that it scatters evenly in all directions (Lambert's law): by fibres of capsules and
    fasciae, and, of a stone, a bone or gas, all of it.

    The values are an estimate: no measurement of renal surfaces was found.
    """

    roughness_mm: float = 0.012
    slope: float = 0.14
    scattered: float = 0.25
    scattered_hard: float = 0.7

    def mirror_and_diffuse(self, wavelength_mm: float) -> tuple[float, float]:
        """The amplitudes, of 1, that it reflects as a mirror and diffusely (Beckmann & Spizzichino 1963)."""
        phase = (4 * np.pi / wavelength_mm * self.roughness_mm) ** 2
        return float(np.exp(-phase / 2)), float(np.sqrt(-np.expm1(-phase)))


@ti.func
def specular(tilt, half_angle):
    """Amplitude of the echo of a smooth interface, relative to no tilt; angles in radians.

    A mirror tilted by an angle turns the beam by twice that: the part of the aperture that it returns to
    receives it. Beyond are edge waves.
    """
    share = tilt / half_angle
    return ti.max(1.0 - share, EDGE * ti.exp(EDGE_FALL * ti.min(1.0 - share, 0.0)))


@ti.func
def diffuse(tilt, half_angle, slope):
    """Energy that a rough interface returns to the aperture, of all that it scatters along one axis; angles
    in radians.

    It scatters around the mirror direction by twice the slope's SD; the beam's own range of angles adds to
    that.
    """
    spread = 4.0 * slope**2 + 2.0 / 3.0 * half_angle**2
    share = ti.min(2.0 * half_angle / ti.sqrt(2.0 * tm.pi * spread), 1.0)
    return share * ti.exp(-2.0 * tilt**2 / spread)


@ti.dataclass
class Interface:
    """A step of impedance that the CT blurs over several tissue samples.

    ``steps`` is the sum of the reflections; ``middle`` is the depth [mm], weighted by them; ``normal`` (u, v,
    w) the sum of the gradients; ``thickness`` is in mm. ``before`` is the impedance in front of it, from
    sample ``begins``.
    """

    steps: ti.f32
    middle: ti.f32
    normal: tm.vec3
    thickness: ti.f32
    before: ti.f32
    begins: ti.i32

    @ti.func
    def begin(self, impedance, sample):
        """Reset to no reflection, behind the tissue of a sample."""
        self.steps, self.middle, self.normal, self.thickness = 0.0, 0.0, tm.vec3(0.0), 0.0
        self.before, self.begins = impedance, sample

    @ti.func
    def add(self, step, depth_mm, gradient, direction, path_mm):
        """Add one step of impedance over a part of the path."""
        self.steps += step
        self.middle += step * depth_mm
        self.normal += gradient
        # Thickness along the normal, not along the beam. An interface thinner than the distance between
        # samples has no gradient.
        size = gradient.norm()
        cosine = ti.select(size > 1e-9, gradient.dot(direction) / ti.max(size, 1e-9), 1.0)
        self.thickness += cosine**2 * path_mm

    @ti.func
    def ends(self, step, max_mm):
        """Whether the next step no longer belongs to this interface."""
        other = step * self.steps <= 0.0 or ti.abs(step) < MIN_REFLECTION or self.thickness > max_mm
        return self.steps != 0.0 and other

    @ti.func
    def reflection(self, after):
        """Reflection coefficient of amplitude between the impedance before it and the one after it
        [MRayl].
        """
        return (after - self.before) / (after + self.before)

    @ti.func
    def refraction(self, direction, ratio):
        """Angle [rad] by which sound is turned on the image plane, towards the next scanline; ``ratio`` is of
        the speeds behind and before.

        Snell's law; where all is reflected, as at the angle at which that begins.
        """
        along, lateral = self.normal.dot(direction), self.normal.dot(tm.vec3(direction.y, -direction.x, 0.0))
        lateral *= ti.select(along < 0.0, -1.0, 1.0)
        incidence = tm.clamp(ti.atan2(lateral, ti.max(ti.abs(along), 1e-9)), -MOST_REFRACTED, MOST_REFRACTED)
        return incidence - ti.asin(tm.clamp(ratio * ti.sin(incidence), -1.0, 1.0))

    @ti.func
    def tilts(self, direction):
        """Angles [rad] between the beam's direction (u, v, 0) and the normal, along and across the image
        plane.
        """
        lateral = tm.vec3(direction.y, -direction.x, 0.0)
        along = ti.max(ti.abs(self.normal.dot(direction)), 1e-9)
        tilts = tm.vec2(0.0)
        if self.normal.norm() > 1e-9:
            tilts = tm.vec2(
                ti.atan2(ti.abs(self.normal.dot(lateral)), along), ti.atan2(ti.abs(self.normal.z), along)
            )
        return tilts
