"""The B-mode image: the echo signal of each scanline through the deformed tissue, converted to grey values.

1. ``Propagation``: what each scanline passes through, and how much sound arrives.
2. ``_scatter``: the signal of scatterers, with the clutter that side lobes receive.
3. ``_lengthen``: attenuation takes the high frequencies, so that the pulse becomes longer.
4. ``_reflect``: the echoes of interfaces.
5. ``spread``: the beam's width across the scanlines, electronic noise, then the envelope in dB, with gain and
   TGC.
6. ``_scan_convert``: from scanlines and samples to the pixels of the image.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from sim.taichi_internals import TASK
from ultrasound.beam import elevation_profiles, profile_depths
from ultrasound.lateral_kernel import (
    CLASSES,
    GROUP,
    LANES,
    MAX_HALF_WIDTH,
    clutter_weights,
    lateral_kernel,
    scanline_classes,
)
from ultrasound.probe import DOPPLER_SETTINGS, GREY_EXPONENTS, DetailLevel, Probe
from ultrasound.propagation import Propagation
from ultrasound.pulse import DB_OF_NEPER, PATH_ENTRIES
from ultrasound.reverberation import FACE, LEAST_REPEATED, Reverberation, ringing
from ultrasound.speckle import COMPONENTS, LEAST_WEIGHT, SIZE, UNIT, Speckle, elevation_levels

Packet = ti.types.vector(LANES, ti.f32)
# The least amplitude that has a logarithm.
SILENCE = 1e-9
# Kernels that lengthen the pulse: by so many SDs, in steps of samples, with so many taps to each side, up to
# so many SDs.
LENGTHS, LENGTH_STEP, LENGTH_TAPS, HALF_WIDTH_SD = 33, 0.125, 10, 2.5
GREY_STEPS = 64


@dataclass(frozen=True)
class Wavefront:
    """A wavefront of a probe in the tissue at rest: around ``apex`` (3,) [mm], or, where it is flat, along
    ``direction`` (3,) from it.

    At ``radius_mm`` from the apex it leaves the array. It is the reference of phases: those of images by the
    same one can be compared.
    """

    apex: np.ndarray
    direction: np.ndarray
    radius_mm: float
    is_flat: bool

    @classmethod
    def of(cls, probe: Probe, world_from_plane: np.ndarray) -> "Wavefront":
        """That of a probe at a pose (4, 4), of tissue that has not moved."""
        steering = np.radians(probe.steering_deg)
        apex = world_from_plane @ [0.0, -probe.radius_mm, 0.0, 1.0]
        direction = world_from_plane[:3, :2] @ [np.sin(steering), np.cos(steering)]
        return cls(apex[:3], direction, probe.radius_mm, probe.sector is None)

    def angle_deg(self, probe: Probe, world_from_plane: np.ndarray) -> float:
        """The largest angle between it and the scanlines of a pose, halfway down: a phase that turns along
        them would be another frequency.
        """
        start, direction = probe.scanlines()
        place = (start + probe.depth_mm / 2 * direction) @ world_from_plane[:3, :2].T + world_from_plane[
            :3, 3
        ]
        along = direction @ world_from_plane[:3, :2].T
        normal = place - self.apex
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        if self.is_flat:
            normal = np.broadcast_to(self.direction, along.shape)
        return float(np.degrees(np.arccos(np.clip((normal * along).sum(axis=1), -1, 1)).max()))


class BMode:
    """B-mode images of the image plane that sound propagates through, for probes with the same numbers of
    scanlines and samples.
    """

    def __init__(self, sound: Propagation, probe: Probe) -> None:
        self.sound, self.plane, self.speckle = sound, sound.plane, Speckle()
        self.reverberation = Reverberation(sound)
        shape = self.lines, self.samples = probe.number_of_scanlines, probe.number_of_samples_per_scanline
        most, packets, self.groups = self.sound.most, self.samples // LANES, -(-self.lines // GROUP)
        # Scattered signal, with room for the taps that lengthen it; and the signal of the scanlines.
        padded = self.lines, self.samples + 2 * LENGTH_TAPS
        self.scattered_real, self.scattered_imaginary = (zeros(*padded) for _ in range(2))
        self.real, self.imaginary, self.decibel = (zeros(*shape) for _ in range(3))
        # Signal after the spread, where it is asked for.
        self.iq = zeros(*shape, 2, within=1)
        self.level = zeros(self.lines, most)
        self.energy = zeros(self.groups, most)
        # Energy that side lobes receive, and what they would receive if it were 1 everywhere.
        self.clutter = zeros(self.groups, most, 2, within=1)
        self.clutter_weight = zeros(most, 2 * self.groups - 1)
        # Lengths of the noise across the plane (``elevation_levels``); lengths along the beam by the path.
        self.elevation = zeros(most, 4, within=1)
        self.axial_sd, self.speckle_sd = (zeros(PATH_ENTRIES) for _ in range(2))
        self.length_weight = zeros(LENGTHS, 2 * LENGTH_TAPS + 1)
        self.weight = zeros(CLASSES, packets, 2 * MAX_HALF_WIDTH + 1)
        self.half = zeros(CLASSES, packets, kind=ti.i32)
        # Factor that restores unit mean square of speckle after the spread.
        self.speckle_gain = zeros(CLASSES, packets)
        self.scanline_class, self.side = zeros(self.lines, kind=ti.i32), zeros(self.lines, kind=ti.i32)
        self.gain = zeros(self.samples)
        self.ringing = zeros(2, self.samples)
        # Grey value at even steps of the dynamic range.
        self.grey = zeros(GREY_STEPS + 1)
        self.source = zeros(self.plane.pixels, self.plane.pixels, 2, within=1)
        self._table_settings: tuple | None = None
        # Whether the scanlines reach a pixel (rows, columns).
        self.covered = np.zeros(self.plane.shape, bool)

    def render(self, probe: Probe, detail_level: DetailLevel = "speckle") -> np.ndarray:
        """Grey values (rows, columns) uint8 of the plane located last, for a probe with the same numbers of
        scanlines and samples.

        ``decibel`` then holds its scanlines, ``real`` and ``imaginary`` their echo.
        """
        self._make_tables(probe)
        self.sound.run(probe, thick=detail_level == "elevation")
        stride = self.sound.stride_of(probe)
        has_speckle = detail_level != "reflection"
        if has_speckle:
            self.reverberation.run(self.samples // stride + 1, stride * probe.sample_mm)
        speckle_sd, look = probe.speckle_sd_mm, round(8 * probe.steering_deg)
        self._set_levels(has_speckle, self.samples // stride + 1)
        if has_speckle:
            self._scatter(stride, speckle_sd, look)
            self._lengthen(stride, speckle_sd, probe.sample_mm)
        else:
            self._scatter_evenly(stride)
        path = self.reverberation.path if has_speckle else self.sound.path
        self._reflect(path, has_speckle, stride, probe.sample_mm, speckle_sd, look)
        if has_speckle:
            self.spread(10.0 ** (probe.noise_before_gain_db / 20.0), self.plane.noise_key, False)
        else:
            self._add()
        return self.scan_converted(probe)

    def scan_converted(self, probe: Probe) -> np.ndarray:
        """Grey values (rows, columns) uint8 of ``decibel``, for the settings of the probe rendered last."""
        image = np.empty(self.plane.shape, np.uint8)
        self._scan_convert(probe.dyn_range_db, image)
        return image

    def iq_of_last(self, probe: Probe, wavefront: Wavefront) -> tuple[np.ndarray, np.ndarray]:
        """The IQ signal (scanlines, samples) complex64 of the image rendered last, and rest positions (.., 3)
        [mm] of its samples.

        Its phase is that of the carrier: it turns with the distance of the tissue from the array, so that
        motion can be measured. ``real``, ``imaginary`` and ``decibel`` stay as they are.
        """
        signal = self.real, self.imaginary, self.decibel
        before = [array_of(field) for field in signal]
        stride = self.sound.stride_of(probe)
        rest = np.empty((self.lines, self.samples, 3), np.float32)
        turn = 4 * np.pi / probe.wavelength_mm
        apex, direction = (tm.vec3(*map(float, vector)) for vector in (wavefront.apex, wavefront.direction))
        self._turn(
            stride, probe.sample_mm, turn, wavefront.is_flat, apex, direction, wavefront.radius_mm, rest
        )
        self.spread(10.0 ** (probe.noise_before_gain_db / 20.0), self.plane.noise_key, True)
        fill(*zip(signal, before, strict=True))
        return array_of(self.iq) @ np.array([1, 1j], np.complex64), rest

    @kernel
    def _turn(
        self,
        stride: int,
        sample_mm: float,
        turn: float,
        is_flat: ti.template(),
        apex: tm.vec3,
        direction: tm.vec3,
        radius_mm: float,
        rest_mm: ti.types.ndarray(ti.f32, ndim=3),
    ):
        """Turn the phase of the signal by its distance from where a wavefront meets its tissue."""
        for line, i in ti.ndrange(self.lines, self.samples):
            at = (i + 0.5) / stride
            k = ti.cast(at, ti.i32)
            rest = tm.mix(self.sound.rest[line, k], self.sound.rest[line, k + 1], at - k)
            away = (rest - apex).dot(direction)
            if ti.static(not is_flat):
                away = (rest - apex).norm() - radius_mm
            depth = tm.mix(self.sound.depth[line, k], self.sound.depth[line, k + 1], at - k)
            # Where sound is slower, the same distance is a longer time.
            slower = (i + 0.5) * sample_mm / ti.max(depth, 1e-6)
            phase = -turn * slower * (depth - away)
            real, imaginary = self.real[line, i], self.imaginary[line, i]
            self.real[line, i] = real * ti.cos(phase) - imaginary * ti.sin(phase)
            self.imaginary[line, i] = real * ti.sin(phase) + imaginary * ti.cos(phase)
            for axis in ti.static(range(3)):
                rest_mm[line, i, axis] = rest[axis]

    def _make_tables(self, probe: Probe) -> None:
        """Update the tables of the probe's settings, if these changed."""
        grey = 255 * np.linspace(0, 1, GREY_STEPS + 1) ** GREY_EXPONENTS[probe.grey_map]
        fill((self.gain, probe.gain_db()), (self.grey, grey))
        free = {
            "gain_percent",
            "dyn_range_db",
            "grey_map",
            "time_gain_compensation",
            "noise_db",
            *DOPPLER_SETTINGS,
        }
        fixed = probe.model_dump(exclude=free)
        settings = *fixed.items(), self.plane.shape, self.sound.surface
        if self._table_settings == settings:
            return
        self._table_settings = settings
        source = padded_source(probe, self.plane.shape, self.source.shape)
        self.covered = source[: self.plane.shape[0], : self.plane.shape[1], 0] >= -0.5
        depth = self.sound.stride_of(probe) * probe.sample_mm * np.arange(self.sound.most)
        nodes = profile_depths(probe)
        slice_sd, correlation_sd = (
            np.interp(depth, nodes, profile) for profile in elevation_profiles(probe, nodes)
        )
        self.sound.set_probe(probe, slice_sd)
        weights, half, speckle_gain = lateral_kernel(probe)
        classes, side = scanline_classes(probe)
        fill(
            (self.clutter_weight, clutter_weights(probe, depth)),
            (self.elevation, elevation_levels(correlation_sd)),
            (self.axial_sd, probe.pulse.axial_sd_mm),
            (self.speckle_sd, probe.pulse.speckle_sd_mm),
            (self.length_weight, length_weights(probe.speckle_sd_mm / probe.sample_mm)),
            (self.speckle_gain, speckle_gain),
            (self.weight, weights),
            (self.half, half),
            (self.scanline_class, classes),
            (self.side, side),
            (self.ringing, ringing(probe)),
            (self.source, source),
        )

    @kernel
    def _set_levels(self, has_clutter: ti.template(), count: int):
        """Set the level of scattering at each tissue sample, with the clutter."""
        for line, k in ti.ndrange(self.lines, count):
            level = self.sound.amplitude[line, k] * self.sound.tissue[line, k].z
            if ti.static(has_clutter):
                level += self.reverberation.level[line, k]
            self.level[line, k] = level
        if ti.static(has_clutter):
            for group, k in ti.ndrange(self.groups, count):
                first, last = group * GROUP, ti.min((group + 1) * GROUP, self.lines)
                total = 0.0
                for line in range(first, last):
                    total += self.level[line, k] ** 2
                self.energy[group, k] = total / (last - first)
            for group, k in ti.ndrange(self.groups, count):
                received = tm.vec2(0.0)
                for other in range(self.groups):
                    weight = self.clutter_weight[k, other - group + self.groups - 1]
                    received += weight * tm.vec2(self.energy[other, k], 1.0)
                self.clutter[group, k] = received
            for line, k in ti.ndrange(self.lines, count):
                at = tm.clamp((line + 0.5) / GROUP - 0.5, 0.0, self.groups - 1.001)
                group = ti.cast(at, ti.i32)
                clutter = tm.mix(self.clutter[group, k], self.clutter[group + 1, k], at - group)
                self.level[line, k] = ti.sqrt((self.level[line, k] ** 2 + clutter.x) / (1.0 + clutter.y))

    @kernel
    def _scatter_evenly(self, stride: ti.template()):
        """Write the level itself, without speckle."""
        for line, k in ti.ndrange(self.lines, self.samples // stride):
            for j in ti.static(range(stride)):
                level = tm.mix(self.level[line, k], self.level[line, k + 1], (j + 0.5) / stride)
                self.real[line, stride * k + j] = level

    @kernel
    def _scatter(self, stride: ti.template(), speckle_sd: float, look: int):
        """Write the signal of scatterers: noise of the rest position, times the level."""
        for line, k in ti.ndrange(self.lines, self.samples // stride):
            first = LENGTH_TAPS + stride * k
            for j in range(stride):
                self.scattered_real[line, first + j] = 0.0
                self.scattered_imaginary[line, first + j] = 0.0
            axis = self.speckle.long_axis(self.sound.across[line, k])
            for component in range(COMPONENTS):
                weight = self.speckle.weight(component, axis, self.elevation[k])
                if weight > LEAST_WEIGHT:
                    key, matrix = self.speckle.component(component, axis, self.elevation[k], speckle_sd, look)
                    near, far = matrix @ self.sound.rest[line, k], matrix @ self.sound.rest[line, k + 1]
                    for j in ti.static(range(stride)):
                        t = (j + 0.5) / stride
                        noise = self.speckle.at(tm.mix(near, far, t), key)
                        noise *= weight * tm.mix(self.level[line, k], self.level[line, k + 1], t)
                        i = first + j
                        self.scattered_real[line, i] = self.scattered_real[line, i] + noise.x
                        self.scattered_imaginary[line, i] = self.scattered_imaginary[line, i] + noise.y

    @kernel
    def _lengthen(self, stride: ti.template(), speckle_sd: float, sample_mm: float):
        """Lengthen the pulse as attenuation on the path has done, and scale speckle for the spread that
        follows.
        """
        for packet, line in ti.ndrange(self.samples // LANES, self.lines):
            first = packet * LANES
            path = self.reverberation.path[line, (first + LANES // 2) // stride]
            more = (
                ti.sqrt(ti.max(self.sound.at_path(self.speckle_sd, path) ** 2 - speckle_sd**2, 0.0))
                / sample_mm
            )
            length = ti.min(ti.round(more / LENGTH_STEP, ti.i32), LENGTHS - 1)
            half = ti.min(ti.ceil(HALF_WIDTH_SD * length * LENGTH_STEP, ti.i32), LENGTH_TAPS)
            real, imaginary = Packet(0.0), Packet(0.0)
            tap = -half
            while tap <= half:
                weight, at = self.length_weight[length, tap + LENGTH_TAPS], first + tap + LENGTH_TAPS
                real += weight * self.packet(self.scattered_real, line, at)
                imaginary += weight * self.packet(self.scattered_imaginary, line, at)
                tap += 1
            gain = self.speckle_gain[self.scanline_class[line], packet]
            contact = self.sound.contact[line]
            for i in ti.static(range(LANES)):
                rings = tm.mix(self.ringing[0, first + i], self.ringing[1, first + i], contact)
                self.real[line, first + i] = gain * real[i] + rings
                self.imaginary[line, first + i] = gain * imaginary[i]

    @kernel
    def _reflect(
        self,
        path: ti.template(),
        has_speckle: ti.template(),
        stride: ti.template(),
        sample_mm: float,
        speckle_sd: float,
        look: int,
    ):
        """Add the echoes of the interfaces, after the sound's path [Np/MHz] to each tissue sample."""
        for n in range(self.lines * TASK):
            if n % TASK == 0:
                for k in range(1, self.samples // stride + 1):
                    for kind in ti.static(range(2)):
                        echo = (self.sound.echo, self.sound.capsule)[kind][n // TASK, k]
                        if echo.z > 0.0:
                            self.reflect(
                                path,
                                has_speckle,
                                n // TASK,
                                k,
                                echo,
                                stride * sample_mm,
                                sample_mm,
                                speckle_sd,
                                look,
                            )

    @ti.func
    def reflect(
        self,
        path: ti.template(),
        has_speckle: ti.template(),
        line,
        k,
        echo,
        step_mm,
        sample_mm,
        speckle_sd,
        look,
    ):
        """Add an echo in front of a tissue sample: as long as the pulse."""
        amplitude, own_path = self.sound.echo_amplitude(path, line, echo, step_mm)
        diffuse, sd = tm.vec2(0.0, 0.0), self.axial_sd[0]
        if ti.static(has_speckle):
            diffuse = amplitude * echo.y * self.speckle_at(line, echo.z / step_mm, speckle_sd, look)
            sd = self.sound.at_path(self.axial_sd, own_path)
            mirror = ti.abs(amplitude * echo.x)
            if mirror > LEAST_REPEATED:
                # Once more by way of the face.
                self.add_pulse(line, 2.0 * echo.z / sample_mm - 0.5, sd / sample_mm, FACE * mirror**2)
        at, reach = echo.z / sample_mm - 0.5, ti.ceil(3.5 * sd / sample_mm, ti.i32)
        first = ti.max(ti.floor(at, ti.i32) - reach, 0)
        last = ti.min(ti.floor(at, ti.i32) + reach + 1, self.samples - 1)
        for i in range(first, last + 1):
            off = (i - at) * sample_mm / sd
            pulse = ti.exp(-0.5 * off * off)
            if ti.static(has_speckle):
                gain = self.speckle_gain[self.scanline_class[line], i // LANES]
                self.real[line, i] = self.real[line, i] + pulse * (amplitude * echo.x + gain * diffuse.x)
                self.imaginary[line, i] = self.imaginary[line, i] + pulse * gain * diffuse.y
            else:
                both = amplitude * ti.sqrt(echo.x**2 + echo.y**2)
                self.real[line, i] = self.real[line, i] + pulse * both

    @ti.func
    def add_pulse(self, line, at, sd, amplitude):
        """Add an echo at a fractional sample, of a length in samples."""
        reach = ti.ceil(3.5 * sd, ti.i32)
        first = ti.max(ti.floor(at, ti.i32) - reach, 0)
        for i in range(first, ti.min(ti.floor(at, ti.i32) + reach + 2, self.samples)):
            off = (i - at) / sd
            self.real[line, i] = self.real[line, i] + amplitude * ti.exp(-0.5 * off * off)

    @ti.func
    def speckle_at(self, line, at, speckle_sd, look):
        """The speckle (2,) at a fractional tissue sample of a scanline."""
        k = ti.cast(at, ti.i32)
        rest = tm.mix(self.sound.rest[line, k], self.sound.rest[line, k + 1], at - k)
        axis, speckle = self.speckle.long_axis(self.sound.across[line, k]), tm.vec2(0.0)
        for component in range(COMPONENTS):
            weight = self.speckle.weight(component, axis, self.elevation[k])
            if weight > LEAST_WEIGHT:
                key, matrix = self.speckle.component(component, axis, self.elevation[k], speckle_sd, look)
                speckle += weight * self.speckle.at(matrix @ rest, key)
        return speckle

    @kernel
    def _add(self):
        for line, sample in ti.ndrange(self.lines, self.samples):
            envelope = ti.abs(self.real[line, sample])
            self.decibel[line, sample] = DB_OF_NEPER * ti.log(envelope + SILENCE) + self.gain[sample]

    @kernel
    def spread(self, noise: float, key: int, keeps: ti.template()):
        """Spread the scanlines as the beam is wide, add electronic noise, and take the envelope in dB;
        keep the signal or not.
        """
        # Scanline by scanline at one depth: the samples that neighbours share stay in the L1 cache.
        for packet, line in ti.ndrange(self.samples // LANES, self.lines):
            first = packet * LANES
            real, imaginary = Packet(0.0), Packet(0.0)
            line_class, side = self.scanline_class[line], self.side[line]
            half = self.half[line_class, packet]
            k = -half
            # LLVM would vectorize a for loop over scanlines instead of lanes, which takes four times as long.
            while k <= half:
                # Beyond the ends of the array the scanlines are mirrored.
                m = ti.abs(line + k)
                m = ti.min(m, 2 * (self.lines - 1) - m)
                # Conjugate, so that noise does not add coherently to itself; reflections are real.
                turned = 1.0 if m == line + k else -1.0
                weight = self.weight[line_class, packet, side * k + MAX_HALF_WIDTH]
                real += weight * self.packet(self.real, m, first)
                imaginary += turned * weight * self.packet(self.imaginary, m, first)
                k += 1
            electronic = self.electronic_noise(line, packet, key)
            real += noise * electronic[0, :]
            imaginary += noise * electronic[1, :]
            if ti.static(keeps):
                for i in ti.static(range(LANES)):
                    self.iq[line, first + i] = tm.vec2(real[i], imaginary[i])
            gain = Packet([self.gain[first + i] for i in ti.static(range(LANES))])
            decibel = DB_OF_NEPER * ti.log(ti.sqrt(real * real + imaginary * imaginary) + SILENCE) + gain
            for i in ti.static(range(LANES)):
                self.decibel[line, first + i] = decibel[i]

    @ti.func
    def electronic_noise(self, line, packet, key):
        """Noise (2, LANES) of unit mean square, which changes with the key; as long as the pulse, but on one
        scanline.
        """
        rows, packets = ti.static(SIZE * SIZE, SIZE // LANES)
        row = (line * 3 + (line // 21) * 320 + (packet // packets) * 448 + key) & (rows - 1)
        at = row * SIZE + (packet % packets) * LANES
        noise = ti.Matrix.zero(ti.f32, 2, LANES)
        for i in ti.static(range(LANES)):
            word = self.speckle.noise[at + i]
            noise[0, i] = UNIT * ((word << 16) >> 16)
            noise[1, i] = UNIT * (word >> 16)
        return noise

    @ti.func
    def packet(self, field: ti.template(), row, first):
        """LANES entries of a row of a field."""
        return Packet([field[row, first + i] for i in ti.static(range(LANES))])

    @kernel
    def _scan_convert(self, dynamic_range_db: float, image: ti.types.ndarray(ti.u8, ndim=2)):
        columns = image.shape[1]
        # The index of a row costs a division: one for several pixels.
        for row, packet in ti.ndrange(image.shape[0], (columns + LANES - 1) // LANES):
            for column in range(packet * LANES, ti.min((packet + 1) * LANES, columns)):
                grey = self.grey_at(self.source[row, column], dynamic_range_db)
                image[row, column] = ti.cast(grey + 0.5, ti.u8)

    @ti.func
    def grey_at(self, at, dynamic_range_db):
        """The grey value at a fractional scanline and sample; 0 outside the image."""
        grey = 0.0
        if at.x >= -0.5:
            x, y = tm.clamp(at.x, 0.0, self.lines - 1.001), tm.clamp(at.y, 0.0, self.samples - 1.001)
            line, sample = ti.cast(x, ti.i32), ti.cast(y, ti.i32)
            along = y - sample
            low = tm.mix(self.decibel[line, sample], self.decibel[line, sample + 1], along)
            high = tm.mix(self.decibel[line + 1, sample], self.decibel[line + 1, sample + 1], along)
            share = tm.clamp(tm.mix(low, high, x - line) / dynamic_range_db + 1.0, 0.0, 1.0)
            step = ti.min(ti.cast(share * GREY_STEPS, ti.i32), GREY_STEPS - 1)
            grey = tm.mix(self.grey[step], self.grey[step + 1], share * GREY_STEPS - step)
        return grey


def source_of_pixels(probe: Probe, rows: int, columns: int) -> np.ndarray:
    """Scanline and sample index, fractional, of each pixel's centre, (rows, columns, 2) float32; -1 outside
    the image.
    """
    width, depth, above = probe.extent_mm
    u = (np.arange(columns) + 0.5) / columns * width - width / 2
    v = (np.arange(rows) + 0.5) / rows * depth - above
    line, along = probe.beam_coordinates(*np.meshgrid(u, v))
    within = (
        (line >= -0.5) & (line <= probe.number_of_scanlines - 0.5) & (along >= 0) & (along <= probe.depth_mm)
    )
    source = np.stack([line, along / probe.sample_mm - 0.5], axis=-1)
    return np.where(within[..., None], source, -1.0).astype(np.float32)


def padded_source(probe: Probe, shape: tuple[int, int], most: tuple[int, ...]) -> np.ndarray:
    """``source_of_pixels`` of an image of a shape, filled up to the shape ``most``."""
    source = np.zeros((*most, 2), np.float32)
    source[: shape[0], : shape[1]] = source_of_pixels(probe, *shape)
    return source


def length_weights(pulse_sd: float) -> np.ndarray:
    """Kernels (LENGTHS, 2 LENGTH_TAPS + 1) that lengthen noise of a correlation SD, by SDs of LENGTH_STEP
    each, in samples.

    They preserve the mean square.
    """
    tap = np.arange(-LENGTH_TAPS, LENGTH_TAPS + 1)
    sd = LENGTH_STEP * np.arange(LENGTHS)[:, None]
    half = np.minimum(np.ceil(HALF_WIDTH_SD * sd), LENGTH_TAPS)
    weights = np.exp(-0.5 * (tap / np.maximum(sd, 0.05)) ** 2) * (np.abs(tap) <= half)
    correlation = np.exp(-(((tap[:, None] - tap) / pulse_sd) ** 2) / 4)
    return weights / np.sqrt(np.einsum("ni,ij,nj->n", weights, correlation, weights))[:, None]
