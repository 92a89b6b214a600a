"""Rays from the aperture to each sample of a scanline: contact, attenuation and refraction on their paths.

A shadow is soft where a part of the aperture sees past an obstacle, and beside a round one where refraction
moves the rays apart.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import fill, zeros
from sim.kernels import kernel
from sim.taichi_internals import TASK
from ultrasound.probe import Probe
from ultrasound.pulse import DB_OF_NEPER, PATH_ENTRIES, PATH_STEP

# Rays to each sample.
RAYS = 7
# Intensity changes by refraction by no more than this factor.
MOST_FOCUSED = 3.0
# Entries of the table of amplitudes for each of the table in dB, between which these are straight.
FINER = 4


class ApertureRays:
    """Rays to each of ``most`` samples of ``lines`` scanlines: (RAYS, scanlines, samples) at their ends.

    ``amplitude`` and ``path`` [Np/MHz] are one way. ``refraction`` has the angle by which a ray is turned
    [rad], and its offset [scanlines].
    """

    def __init__(self, lines: int, most: int) -> None:
        self.lines, shape = lines, (RAYS, lines, most)
        self.amplitude, self.path = (zeros(*shape) for _ in range(2))
        self.refraction = zeros(*shape, 2, within=1)
        # How many scanlines a ray is from its end at a sample, where it leaves the face. It goes from
        # scanline to scanline: mixing two would spread shadows.
        self.offset = zeros(RAYS, most, kind=ti.i32)
        # Scanlines per mm; half of the Fresnel zone in scanlines.
        self.lines_per_mm, self.zone = zeros(most), zeros(most, kind=ti.i32)
        self.one_way = zeros(FINER * PATH_ENTRIES)

    def set_probe(self, probe: Probe, depth_mm: np.ndarray) -> None:
        """Update the tables of a probe's settings, at the depths of the samples."""
        entries = np.arange(FINER * PATH_ENTRIES) / FINER
        decibel = np.interp(entries, np.arange(PATH_ENTRIES), probe.pulse.speckle_db)
        fill(
            (self.offset, ray_offsets(probe, depth_mm)),
            (self.lines_per_mm, 1 / np.maximum(probe.line_spacing_mm(depth_mm), 1e-3)),
            (self.zone, fresnel_zones(probe, depth_mm)),
            (self.one_way, 10 ** (decibel / 40)),
        )

    @kernel
    def follow(
        self,
        contact: ti.template(),
        tissue: ti.template(),
        depth: ti.template(),
        passed: ti.template(),
        turn: ti.template(),
        count: int,
    ):
        """Follow each ray to the samples of all scanlines, through the tissue of ``Propagation``."""
        for n in range(RAYS * TASK):
            if n % TASK == 0:
                ray = n // TASK
                for line in range(self.lines):
                    self.amplitude[ray, line, 0] = contact[line]
                    self.path[ray, line, 0] = 0.0
                    self.refraction[ray, line, 0] = tm.vec2(0.0)
                for k in range(1, count):
                    aside = self.offset[ray, k] - self.offset[ray, k - 1]
                    for line in range(self.lines):
                        from_line = tm.clamp(line - aside, 0, self.lines - 1)
                        self.follow_ray(tissue, depth, passed, turn, ray, line, k, from_line)

    @ti.func
    def follow_ray(
        self,
        tissue: ti.template(),
        depth: ti.template(),
        passed: ti.template(),
        turn: ti.template(),
        ray,
        line,
        k,
        from_line,
    ):
        """Continue a ray from the sample before, on a scanline."""
        attenuation = 0.5 * (tissue[line, k - 1].y + tissue[line, k].y)
        step_mm = depth[line, k] - depth[line, k - 1]
        path = self.path[ray, from_line, k - 1]
        self.path[ray, line, k] = path + attenuation * step_mm / (10.0 * DB_OF_NEPER)
        self.amplitude[ray, line, k] = self.amplitude[ray, from_line, k - 1] * passed[line, k]
        refraction = self.refraction[ray, from_line, k - 1]
        turned = refraction.x + turn[line, k]
        self.refraction[ray, line, k] = tm.vec2(
            turned, refraction.y + turned * step_mm * self.lines_per_mm[k]
        )

    @kernel
    def combine(
        self, build_up: ti.template(), count: int, round_trip: ti.template(), round_trip_path: ti.template()
    ):
        """Write amplitude and path of the round trip: the mean over the rays that start on the array,
        squared.
        """
        for line, k in ti.ndrange(self.lines, count):
            total, path, ray_count = 0.0, 0.0, 0.0
            for ray in ti.static(range(RAYS)):
                origin = line - self.offset[ray, k]
                if origin >= 0 and origin < self.lines:
                    along = self.path[ray, line, k]
                    one_way = self.amplitude[ray, line, k] * self.attenuated(along)
                    one_way *= self.focusing(ray, line, k)
                    total += one_way
                    path += one_way * along
                    ray_count += 1.0
            round_trip[line, k] = build_up[k] * (total / ray_count) ** 2
            round_trip_path[line, k] = 2.0 * path / ti.max(total, 1e-30)

    @ti.func
    def focusing(self, ray, line, k):
        """The factor of amplitude of rays that refraction has moved together or apart, over a Fresnel
        zone.
        """
        zone = self.zone[k]
        low, high = ti.max(line - zone, 0), ti.min(line + zone, self.lines - 1)
        further = self.refraction[ray, high, k].y - self.refraction[ray, low, k].y
        apart = 1.0 + further / ti.max(high - low, 1)
        return 1.0 / ti.sqrt(tm.clamp(apart, 1.0 / MOST_FOCUSED, MOST_FOCUSED))

    @ti.func
    def attenuated(self, path):
        """The amplitude of speckle that attenuation on a path one way [Np/MHz] leaves, one way."""
        at = ti.min(path * (2.0 * FINER / PATH_STEP), FINER * PATH_ENTRIES - 1.001)
        first = ti.cast(at, ti.i32)
        return tm.mix(self.one_way[first], self.one_way[first + 1], at - first)


def fresnel_zones(probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """Half of the Fresnel zone halfway to each depth, at least one scanline, (depths,) int32: less does not
    bend a wave.
    """
    zone_mm = np.sqrt(probe.wavelength_mm * depth_mm) / 2
    return np.maximum(np.rint(zone_mm / np.maximum(probe.line_spacing_mm(depth_mm), 1e-3)), 1).astype(
        np.int32
    )


def ray_offsets(probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """How many scanlines beside its end at a depth each ray leaves the face (RAYS, depths) int32.

    Each ray stands for an equal part of the aperture.
    """
    if probe.transducer_geometry == "PHASED":
        # All scanlines start at one point: rays of other elements are not among them.
        return np.zeros((RAYS, len(depth_mm)), np.int32)
    slope = (2 * (np.arange(RAYS) + 0.5) / RAYS - 1)[:, None] / (2 * probe.f_number)
    spacing = probe.line_spacing_mm(np.zeros(1))[0]
    if probe.sector is None:
        offset = slope * depth_mm / spacing
    else:
        radius = probe.radius_mm
        offset = slope * np.log1p(depth_mm / radius) * radius / spacing
    return np.rint(offset).astype(np.int32)
