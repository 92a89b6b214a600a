"""The B-mode image: the echo signal of each scanline through the deformed tissue, converted to grey values.

1. ``_find_contact``: which elements of the array are in contact.
2. ``_simulate``: a pulse travels along each scanline, is attenuated, reflected and scattered.
3. ``_spread``: the point-spread function across the scanlines, then the envelope in dB, with gain and TGC.
4. ``_scan_convert``: from scanlines and samples to the pixels of the image.
"""

from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.device import TASK
from sim.fields import fill
from ultrasound.probe import DETAIL_LEVELS, DetailLevel, Probe
from ultrasound.sampled_volume import SampledVolume
from ultrasound.speckle import Speckle

# A probe's samples are a multiple of this.
LANES = 16
Packet = ti.types.vector(LANES, ti.f32)
# Samples between two tissue samples: the larger stride where it is no longer than a voxel.
STRIDES = (8, 4)
NOISE_FLOOR = 1e-9
# Half width of the lateral kernel, in standard deviations and at most in scanlines.
HALF_WIDTH_SD, MAX_HALF_WIDTH = 2.5, 24
# Parallel planes that sample the slice thickness: offset in standard deviations, weight in a mean, and weight in a sum of noise
# that preserves its mean square.
CENTRAL_PLANE = ((0.0, 1.0, 1.0),)
THICK_PLANE = tuple(
    (offset, weight / 2.0, weight / 1.5**0.5) for offset, weight in ((0.0, 1.0), (-1.2, 0.5), (1.2, 0.5))
)
# A smaller relative change of impedance between two samples is no interface.
MIN_REFLECTION = 3e-4
# Decibels per neper of amplitude.
DB = 8.685889638065037


@ti.dataclass
class Interface:
    """A step of impedance that the CT blurs over several tissue samples.

    ``steps`` is the sum of the reflections; ``middle`` and ``incidence`` are depth [mm] and incidence factor, weighted by them;
    ``thickness`` is in mm. ``before`` is the tissue in front of it, from depth ``begins`` [mm], where the pulse has ``amplitude``.
    """

    steps: ti.f32
    middle: ti.f32
    incidence: ti.f32
    thickness: ti.f32
    before: tm.vec3
    begins: ti.f32
    amplitude: ti.f32

    @ti.func
    def begin(self, tissue, depth_mm, amplitude):
        """Reset to no reflection, behind the given tissue."""
        self.steps, self.middle, self.incidence, self.thickness = 0.0, 0.0, 0.0, 0.0
        self.before, self.begins, self.amplitude = tissue, depth_mm, amplitude

    @ti.func
    def add(self, step, depth_mm, incidence, path_mm):
        """Add one step of impedance over a part of the path."""
        self.steps += step
        self.middle += step * depth_mm
        self.incidence += step * incidence
        # Thickness along the normal, not along the beam.
        self.thickness += incidence * incidence * path_mm

    @ti.func
    def ends(self, step, max_mm):
        """Whether the next step no longer belongs to this interface."""
        other = step * self.steps <= 0.0 or ti.abs(step) < MIN_REFLECTION or self.thickness > max_mm
        return self.steps != 0.0 and other

    @ti.func
    def reflection(self, after):
        """Reflection coefficient of amplitude between the impedance before it and the one after it [MRayl]."""
        return (after - self.before.x) / (after + self.before.x)

    @ti.func
    def depth_mm(self):
        """Depth of its centre."""
        return self.middle / self.steps

    @ti.func
    def echo(self, after, frequency_mhz):
        """Amplitude of its echo, as one step at its centre; the tissue before it attenuates up to there."""
        path_db = 2.0 * self.before.y * frequency_mhz * (self.depth_mm() - self.begins) / 10.0
        return (
            ti.abs(self.reflection(after))
            * self.amplitude
            * ti.exp(-path_db / DB)
            * self.incidence
            / self.steps
        )


@ti.dataclass
class TissueSample:
    """Impedance, attenuation and backscatter; the rest position [mm]; the map (3, 4) from the image plane to it."""

    tissue: tm.vec3
    rest: tm.vec3
    linear: ti.types.matrix(3, 4, ti.f32)


@ti.data_oriented
class BMode:
    """B-mode images of an image plane in tissue.

    ``tissue`` is a volume (.., 3) of impedance, attenuation and backscatter (``acoustics.properties``), ``organ`` the signed
    distance from the organ's surface [mm], both at rest, ``plane`` a ``PlaneInTissue`` of the scanner. An element transmits only in contact: with the organ, nearer than
    ``contact_gap_mm``, or, where ``contact`` is "tissue", with anything but gas. ``around`` is the impedance [MRayl] of all that is
    outside the organ; None for what the CT shows there.
    """

    def __init__(
        self,
        tissue: SampledVolume,
        organ: SampledVolume,
        plane: Any,
        probe: Probe,
        voxel_mm: float,
        contact: str = "organ",
        contact_gap_mm: float = 1.5,
        around: float | None = None,
    ) -> None:
        self.tissue, self.organ, self.plane, self.voxel_mm = tissue, organ, plane, voxel_mm
        # A CT blurs an interface by about a voxel to each side.
        self.interface_mm = 5.0 * voxel_mm
        self.by_organ, self.gap_mm = contact == "organ", contact_gap_mm
        self.organ_alone, self.around = around is not None, around or 0.0
        self.speckle = Speckle()
        shape = self.lines, self.samples = probe.number_of_scanlines, probe.number_of_samples_per_scanline
        self.start, self.direction, self.element = (ti.Vector.field(2, ti.f32, self.lines) for _ in range(3))
        self.contacts_before = ti.field(ti.i32, self.lines + 1)
        self.real, self.imaginary, self.decibel = (ti.field(ti.f32, shape) for _ in range(3))
        # Factor by sample that restores unit mean square of speckle after the point-spread function.
        self.speckle_gain = ti.field(ti.f32, self.samples)
        self.weight = ti.field(ti.f32, (2 * MAX_HALF_WIDTH + 1, self.samples))
        self.half = ti.field(ti.i32, self.samples // LANES)
        self.gain = ti.field(ti.f32, self.samples)
        self.source = ti.Vector.field(2, ti.f32, (plane.pixels, plane.pixels))
        self._table_settings: tuple | None = None

    def render(self, probe: Probe, detail_level: DetailLevel = "speckle") -> np.ndarray:
        """Return grey values (rows, columns) uint8 of the plane located last, for a probe with the same numbers of scanlines and samples.

        ``decibel`` then holds its scanlines, ``real`` and ``imaginary`` their echo.
        """
        self._make_tables(probe)
        self._find_contact()
        # A phased array transmits every scanline with all of its elements.
        pitch = 0.0 if probe.transducer_geometry == "PHASED" else float(probe.line_spacing_mm(np.zeros(1))[0])
        aperture = 0.5 / (probe.f_number * pitch) if pitch else 1e6
        beam = probe.sample_mm, probe.frequency_mhz, aperture, probe.axial_sd_mm, probe.elevation_sd_mm
        stride = STRIDES[0] if STRIDES[0] * probe.sample_mm <= self.voxel_mm else STRIDES[1]
        self._simulate(DETAIL_LEVELS.index(detail_level), stride, *beam)
        if detail_level == "reflection":
            self._add()
        else:
            self._spread()
        image = np.empty(self.plane.shape, np.uint8)
        self._scan_convert(probe.dyn_range_db, image)
        return image

    def _make_tables(self, probe: Probe) -> None:
        """Update the tables of the probe's settings, if these changed."""
        fill((self.gain, probe.gain_db()))
        fixed = probe.model_dump(exclude={"gain_percent", "dyn_range_db", "time_gain_compensation"})
        settings = *fixed.items(), self.plane.shape
        if self._table_settings == settings:
            return
        self._table_settings = settings
        source = np.zeros(self.source.shape + (2,), np.float32)
        rows, columns = self.plane.shape
        source[:rows, :columns] = source_of_pixels(probe, rows, columns)
        start, direction = probe.scanlines()
        weights, half, speckle_gain = lateral_weights(probe)
        fill(
            (self.start, start),
            (self.direction, direction),
            (self.element, probe.elements()),
            (self.speckle_gain, speckle_gain),
            (self.weight, weights),
            (self.half, half.reshape(-1, LANES).max(axis=1)),
            (self.source, source),
        )

    @ti.kernel
    def _find_contact(self):
        """Count the array elements in contact: ``contacts_before[i]`` is the number among the elements before i."""
        ti.loop_config(serialize=True)
        for i in range(self.lines):
            place = self.element[i]
            if ti.static(not self.by_organ):
                place.y += 0.5 * self.gap_mm
            row, column = self.plane.pixel_near(place)
            rest = self.plane.rest_from_plane(row, column) @ tm.vec4(place, 0.0, 1.0)
            near = 0
            if ti.static(self.by_organ):
                near = self.plane.is_tissue(row, column) and self.organ.sample(rest) <= self.gap_mm
            else:
                near = self.tissue.sample(rest)[0] > 1.0
            self.contacts_before[i + 1] = self.contacts_before[i] + near

    @ti.func
    def sample_tissue(self, planes: ti.template(), place, elevation_sd: ti.f32):
        """The TissueSample at (u, v) of the image plane [mm]."""
        row, column = self.plane.pixel_near(place)
        linear = self.plane.rest_from_plane(row, column)
        rest = linear @ tm.vec4(place, 0.0, 1.0)
        found = tm.vec3(0.0)
        for off, weight, _ in ti.static(planes):
            found += weight * self.tissue.sample(rest + (off * elevation_sd) * linear[:, 2])
        if ti.static(self.organ_alone):
            if not (self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0):
                found = tm.vec3(self.around, 0.0, 0.0)
        return TissueSample(found, rest, linear)  # type: ignore[call-arg]

    @ti.kernel
    def _simulate(
        self,
        detail_level: ti.template(),
        stride: ti.template(),
        sample_mm: float,
        frequency_mhz: float,
        aperture: float,
        axial_sd: float,
        elevation_sd: float,
    ):
        """Write the echo signal of every scanline, at a detail level (its index); needs ``_find_contact`` before.

        The tissue is sampled every ``stride`` samples. ``aperture`` is in elements to each side, per mm of depth.
        """
        for n in range(self.lines * TASK):
            if n % TASK == 0:
                line = n // TASK
                self.simulate_line(
                    line, detail_level, stride, sample_mm, frequency_mhz, aperture, axial_sd, elevation_sd
                )

    @ti.func
    def simulate_line(
        self,
        line,
        detail_level: ti.template(),
        stride: ti.template(),
        sample_mm: float,
        frequency_mhz: float,
        aperture: float,
        axial_sd: float,
        elevation_sd: float,
    ):
        """Follow the pulse along a scanline."""
        planes = ti.static(THICK_PLANE if detail_level == 2 else CENTRAL_PLANE)
        stride_mm = stride * sample_mm
        start, direction = self.start[line], self.direction[line]
        for i in range(self.samples):
            self.real[line, i] = 0.0
        near = self.sample_tissue(planes, start, elevation_sd)
        loss_db, transmitted, amplitude = 0.0, 1.0, 1.0
        interface = Interface()
        interface.begin(near.tissue, 0.0, amplitude)
        for k in range(self.samples // stride):
            depth = k * stride_mm
            place = start + (depth + stride_mm) * direction
            far = self.sample_tissue(planes, place, elevation_sd)
            # Beyond the CT nothing is known: nothing scatters, nothing reflects.
            far.tissue.x = ti.select(far.tissue.x < 1e-6, near.tissue.x, far.tissue.x)
            near.tissue.x = ti.select(near.tissue.x < 1e-6, far.tissue.x, near.tissue.x)
            before, after = near.tissue, far.tissue
            step = (after.x - before.x) / ti.max(after.x + before.x, 1e-6)
            if interface.ends(step, self.interface_mm):
                at = interface.depth_mm()
                echo = interface.echo(before.x, frequency_mhz) * self.contact_fraction(line, at, aperture)
                self.add_reflection(detail_level, line, at, echo, sample_mm, axial_sd)
                transmitted *= 1.0 - interface.reflection(before.x) ** 2
                interface.begin(before, depth, amplitude)
            if interface.steps == 0.0:
                interface.begin(before, depth, amplitude)
            if ti.abs(step) >= MIN_REFLECTION:
                incidence = self.incidence_factor(0.5 * (near.rest + far.rest), far.linear, direction)
                interface.add(step, depth + 0.5 * stride_mm, incidence, stride_mm)
            # Both directions, over the stride in cm.
            loss_db += (before.y + after.y) * frequency_mhz * stride_mm / 10.0
            amplitude_far = transmitted * ti.exp(-loss_db / DB)
            contact = self.contact_fraction(line, depth + 0.5 * stride_mm, aperture)
            levels = tm.vec3(amplitude, amplitude_far, contact)
            self.add_scatter(detail_level, stride, line, k, near, far, levels, axial_sd, elevation_sd)
            near, amplitude = far, amplitude_far

    @ti.func
    def add_scatter(
        self,
        detail_level: ti.template(),
        stride: ti.template(),
        line,
        k,
        near,
        far,
        levels,
        axial_sd,
        elevation_sd,
    ):
        """Write the scattered signal of stride ``k``; ``levels`` are the amplitude at its two ends and the contact fraction."""
        for j in range(stride):
            t = (j + 0.5) / stride
            rest, across = tm.mix(near.rest, far.rest, t), tm.mix(near.linear[:, 2], far.linear[:, 2], t)
            echo = self.scatter(detail_level, rest, across, axial_sd, elevation_sd)
            echo *= levels.z * tm.mix(levels.x, levels.y, t) * tm.mix(near.tissue.z, far.tissue.z, t)
            self.real[line, stride * k + j] = self.real[line, stride * k + j] + echo.x
            self.imaginary[line, stride * k + j] = echo.y

    @ti.func
    def scatter(self, detail_level: ti.template(), rest, across, axial_sd, elevation_sd):
        """Speckle (2,) at a rest position [mm], of unit mean square; the constant 1 at the level without speckle."""
        echo = tm.vec2(ti.static(1.0 if detail_level == 0 else 0.0), 0.0)
        for off, _, weight in ti.static(((), CENTRAL_PLANE, THICK_PLANE)[detail_level]):
            echo += weight * self.speckle.at(rest + (off * elevation_sd) * across, axial_sd)
        return echo

    @ti.func
    def contact_fraction(self, line, depth_mm, aperture):
        """Fraction of the active aperture of a scanline at a depth that is in contact."""
        half = ti.min(ti.cast(depth_mm * aperture, ti.i32), self.lines)
        first, last = ti.max(line - half, 0), ti.min(line + half + 1, self.lines)
        return (self.contacts_before[last] - self.contacts_before[first]) / ti.cast(last - first, ti.f32)

    @ti.func
    def incidence_factor(self, rest, linear, direction):
        """Root of the cosine between beam and interface normal: Lambert's law for the intensity (Wein 2008)."""
        # The gradient at rest is carried into the deformed tissue by the inverse transpose of the deformation gradient.
        slope = linear[:, :3].transpose() @ self.tissue.slope(rest)
        # An interface thinner than the distance between samples has no gradient halfway: perpendicular incidence is assumed.
        factor, steep = 1.0, slope.norm()
        if steep > 1e-9:
            factor = ti.sqrt(ti.abs(slope.x * direction.x + slope.y * direction.y) / steep)
        return factor

    @ti.func
    def add_reflection(self, detail_level: ti.template(), line, depth_mm, amplitude, sample_mm, axial_sd):
        """Add the echo of an interface to a scanline, as wide as the pulse and not scaled by ``speckle_gain``."""
        at, reach = depth_mm / sample_mm - 0.5, ti.ceil(3.5 * axial_sd / sample_mm, ti.i32)
        first = ti.max(ti.floor(at, ti.i32) - reach, 0)
        last = ti.min(ti.floor(at, ti.i32) + reach + 1, self.samples - 1)
        for i in range(first, last + 1):
            off = (i - at) * sample_mm / axial_sd
            echo = amplitude * ti.exp(-0.5 * off * off)
            if ti.static(detail_level > 0):
                echo /= self.speckle_gain[i]
            self.real[line, i] = self.real[line, i] + echo

    @ti.kernel
    def _add(self):
        for line, sample in self.decibel:
            envelope = ti.abs(self.real[line, sample])
            self.decibel[line, sample] = DB * ti.log(envelope + NOISE_FLOOR) + self.gain[sample]

    @ti.kernel
    def _spread(self):
        # Scanline by scanline at one depth: the samples that neighbours share stay in the L1 cache.
        for packet, line in ti.ndrange(self.samples // LANES, self.lines):
            first = packet * LANES
            real, imaginary = Packet(0.0), Packet(0.0)
            half = self.half[packet]
            for k in range(-half, half + 1):
                # Beyond the ends of the array the scanlines are mirrored.
                m = ti.abs(line + k)
                m = ti.min(m, 2 * (self.lines - 1) - m)
                # Conjugate, so that noise does not add coherently to itself; reflections are real.
                turned = 1.0 if m == line + k else -1.0
                weight = self.packet(self.weight, k + MAX_HALF_WIDTH, first)
                real += weight * self.packet(self.real, m, first)
                imaginary += turned * weight * self.packet(self.imaginary, m, first)
            speckle_gain = Packet([self.speckle_gain[first + i] for i in ti.static(range(LANES))])
            envelope = speckle_gain * ti.sqrt(real * real + imaginary * imaginary)
            gain = Packet([self.gain[first + i] for i in ti.static(range(LANES))])
            decibel = DB * ti.log(envelope + NOISE_FLOOR) + gain
            for i in ti.static(range(LANES)):
                self.decibel[line, first + i] = decibel[i]

    @ti.func
    def packet(self, field: ti.template(), row, first):
        """Return LANES entries of a row of a field."""
        return Packet([field[row, first + i] for i in ti.static(range(LANES))])

    @ti.kernel
    def _scan_convert(self, dynamic_range_db: float, image: ti.types.ndarray(ti.u8, ndim=2)):
        for row, column in self.source:
            # A range known only now would cost a division for each pixel.
            if row >= image.shape[0] or column >= image.shape[1]:
                continue
            at = self.source[row, column]
            grey = 0.0
            if at.x >= -0.5:
                x, y = tm.clamp(at.x, 0.0, self.lines - 1.001), tm.clamp(at.y, 0.0, self.samples - 1.001)
                line, sample = ti.cast(x, ti.i32), ti.cast(y, ti.i32)
                along = y - sample
                low = tm.mix(self.decibel[line, sample], self.decibel[line, sample + 1], along)
                high = tm.mix(self.decibel[line + 1, sample], self.decibel[line + 1, sample + 1], along)
                grey = 255.0 * (tm.mix(low, high, x - line) / dynamic_range_db + 1.0)
            image[row, column] = ti.cast(tm.clamp(grey, 0.0, 255.0) + 0.5, ti.u8)


def source_of_pixels(probe: Probe, rows: int, columns: int) -> np.ndarray:
    """Return scanline and sample index, fractional, of each pixel's centre, (rows, columns, 2) float32; -1 outside the image."""
    width, depth, above = probe.extent_mm
    u = (np.arange(columns) + 0.5) / columns * width - width / 2
    v = (np.arange(rows) + 0.5) / rows * depth - above
    line, along = probe.beam_coordinates(*np.meshgrid(u, v))
    within = (
        (line >= -0.5) & (line <= probe.number_of_scanlines - 0.5) & (along >= 0) & (along <= probe.depth_mm)
    )
    source = np.stack([line, along / probe.sample_mm - 0.5], axis=-1)
    return np.where(within[..., None], source, -1.0).astype(np.float32)


def lateral_weights(probe: Probe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lateral kernel of the point-spread function at each sample.

    The function is separable: exp(-(x^2 / sa^2 + y^2 / sl^2 + z^2 / se^2) / 2), with the widths of the probe.

    Weights (2 MAX_HALF_WIDTH + 1, samples), of sum 1; the half width in scanlines (samples,); and the speckle gain (samples,), which
    restores unit mean square of noise with the axial width's correlation.
    """
    depth = (np.arange(probe.number_of_samples_per_scanline) + 0.5) * probe.sample_mm
    axial, spacing = probe.axial_sd_mm, probe.line_spacing_mm(depth)
    # The noise already has the width of the pulse in every direction.
    width = np.sqrt(np.maximum(probe.lateral_sd_mm(depth) ** 2 - axial**2, 0)) / np.maximum(spacing, 1e-6)
    half = np.clip(np.ceil(HALF_WIDTH_SD * width), 0, MAX_HALF_WIDTH).astype(np.int32)
    lines = np.arange(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1)[:, None]
    weights = np.exp(-0.5 * (lines / np.maximum(width, 0.05)) ** 2) * (np.abs(lines) <= half)
    weights /= weights.sum(axis=0)
    energy = np.zeros(len(depth))
    for lag in range(len(lines)):
        together = (weights[: len(lines) - lag] * weights[lag:]).sum(axis=0) * (1 if lag == 0 else 2)
        energy += together * np.exp(-((lag * spacing) ** 2) / (4 * axial**2))
    return weights, half, 1 / np.sqrt(energy)
