"""The echo picture: sound sent along each line through the deformed tissue, its echoes made into grey values.

1. ``_touch``: which elements of the array touch tissue.
2. ``_send``: along each line, where the tissue was at rest, what it reflects and scatters, and what is left of the sound.
3. ``_spread``: the point-spread function across the lines, then the envelope in dB, with gain and compensation over depth.
4. ``_scan_convert``: from lines and samples to the pixels of the picture.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from ultrasound.array import RUNGS, Probe, Rung
from ultrasound.plane import Picture, PlaneInTissue
from ultrasound.point_spread import MOST_LINES, axial_sd_mm, elevation_sd_mm, lateral_weights
from ultrasound.speckle import Speckle
from ultrasound.volume import Volume

LANES = 16
Packet = ti.types.vector(LANES, ti.f32)
# Samples from one look into the tissue to the next, the longer one if it is no farther than a voxel: that is how fast tissue changes.
STRIDES = (8, 4)
# The planes that a thick one is made of: how far off in standard deviations, the weight in a mean, and in a sum of noise that
# keeps its mean square.
MIDDLE = ((0.0, 1.0, 1.0),)
THICK = tuple((off, weight / 2.0, weight / 1.5**0.5) for off, weight in ((0.0, 1.0), (-1.2, 0.5), (1.2, 0.5)))
# What changes less from look to look is no interface.
LEAST_REFLECTION = 3e-4
SILENCE = 1e-9
DB = 20.0 / float(np.log(10.0))


@ti.data_oriented
class BMode:
    """The echo of a plane in tissue.

    ``tissue`` is a volume (.., 3) of impedance, attenuation and backscatter (``acoustics.properties``) and ``organ`` the signed
    distance from the organ's surface [mm], both at rest. Sound leaves only where tissue touches the array: the organ, nearer than
    ``contact_gap_mm``, or, with ``contact`` "tissue", anything that is not gas. ``around`` is the impedance [MRayl] of what lies
    outside the organ in the picture; None for what the CT shows there.
    """

    def __init__(
        self,
        tissue: Volume,
        organ: Volume,
        plane: PlaneInTissue,
        probe: Probe,
        voxel_mm: float,
        contact: str = "organ",
        contact_gap_mm: float = 1.0,
        around: float | None = None,
    ) -> None:
        self.tissue, self.organ, self.plane = tissue, organ, plane
        self.voxel_mm = voxel_mm
        # An interface is blurred in a CT by about a voxel to each side, and seen aslant.
        self.interface_mm = 5.0 * voxel_mm
        self.by_organ, self.gap_mm = contact == "organ", contact_gap_mm
        self.organ_alone, self.around = around is not None, around or 0.0
        self.speckle = Speckle()
        self.lines, self.samples = probe.number_of_scanlines, probe.number_of_samples_per_scanline
        lines, samples = self.lines, self.samples
        if samples % LANES:
            raise ValueError(f"{samples} samples a line: expected a multiple of {LANES}")
        self.start, self.direction, self.element = (ti.Vector.field(2, ti.f32, lines) for _ in range(3))
        self.touching = ti.field(ti.i32, lines + 1)
        self.real, self.imaginary, self.decibel = (ti.field(ti.f32, (lines, samples)) for _ in range(3))
        self.weight = ti.field(ti.f32, (2 * MOST_LINES + 1, samples))
        self.half = ti.field(ti.i32, samples // LANES)
        self.loudness, self.gain = ti.field(ti.f32, samples), ti.field(ti.f32, samples)
        self.source = ti.Vector.field(2, ti.f32, (plane.pixels, plane.pixels))
        self._tables_of: tuple | None = None

    def render(self, probe: Probe, rung: Rung = "speckle") -> np.ndarray:
        """Grey values (pixels, pixels) uint8 of the plane that was taken last; ``decibel`` holds its lines.

        Raises ValueError for a probe of other lines or samples than this was made for.
        """
        if (probe.number_of_scanlines, probe.number_of_samples_per_scanline) != (self.lines, self.samples):
            raise ValueError(
                f"{probe.number_of_scanlines} lines of {probe.number_of_samples_per_scanline} samples: this picture "
                f"was made for {self.lines} of {self.samples}"
            )
        self._make_tables(probe)
        places = self.plane.pixel_mm, self.plane.first_mm
        self._touch(*places)
        # A phased array sends every line with all of its elements.
        pitch = 0.0 if probe.transducer_geometry == "PHASED" else float(probe.line_spacing_mm(np.zeros(1))[0])
        aperture = 0.5 / (probe.f_number * pitch) if pitch else 1e6
        sd = axial_sd_mm(probe), elevation_sd_mm(probe)
        stride = STRIDES[0] if STRIDES[0] * probe.sample_mm <= self.voxel_mm else STRIDES[1]
        self._send(RUNGS.index(rung), stride, *places, probe.sample_mm, probe.frequency_mhz, aperture, *sd)
        if rung == "reflection":
            self._add()
        else:
            self._spread()
        picture = np.empty((self.plane.pixels, self.plane.pixels), np.uint8)
        self._scan_convert(probe.dyn_range_db, picture)
        return picture

    def _make_tables(self, probe: Probe) -> None:
        """What depends on the probe's settings alone, made anew when these change."""
        self.gain.from_numpy(probe.gain_db().astype(np.float32))
        fixed = probe.model_dump(exclude={"gain_percent", "dyn_range_db", "time_gain_compensation"})
        if self._tables_of == tuple(fixed.items()):
            return
        self._tables_of = tuple(fixed.items())
        start, direction = probe.scanlines()
        self.start.from_numpy(start.astype(np.float32))
        self.direction.from_numpy(direction.astype(np.float32))
        self.element.from_numpy(probe.elements().astype(np.float32))
        weights, half, loudness = lateral_weights(probe)
        self.weight.from_numpy(weights.astype(np.float32))
        self.half.from_numpy(half.reshape(-1, LANES).max(axis=1).astype(np.int32))
        self.loudness.from_numpy(loudness.astype(np.float32))
        self.source.from_numpy(source_of_pixels(probe, self.plane.pixels))

    @ti.kernel
    def _touch(self, pixel_mm: tm.vec2, first_mm: tm.vec2):
        """Elements that touch, counted from the first on: ``touching[i]`` of those before i."""
        ti.loop_config(serialize=True)
        for i in range(self.lines):
            place = self.element[i]
            if ti.static(not self.by_organ):
                place.y += 0.5 * self.gap_mm
            row, column = self.plane.pixel_near(place, pixel_mm, first_mm)
            rest = self.plane.map_of(row, column) @ tm.vec4(place, 0.0, 1.0)
            near = 0
            if ti.static(self.by_organ):
                near = self.plane.is_tissue(row, column) and self.organ.sample(rest) <= self.gap_mm
            else:
                near = self.tissue.sample(rest)[0] > 1.0
            self.touching[i + 1] = self.touching[i] + near

    @ti.func
    def look(self, linear, row, column, place, planes: ti.template(), elevation_sd: ti.f32):
        """Impedance, attenuation and backscatter at a place (u, v) of the plane, and where its tissue was at rest."""
        rest = linear @ tm.vec4(place, 0.0, 1.0)
        found = tm.vec3(0.0)
        for off, weight, _ in ti.static(planes):
            found += weight * self.tissue.sample(rest + (off * elevation_sd) * linear[:, 2])
        if ti.static(self.organ_alone):
            if not (self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0):
                found = tm.vec3(self.around, 0.0, 0.0)
        return found, rest

    @ti.kernel
    def _send(
        self,
        rung: ti.template(),
        stride: ti.template(),
        pixel_mm: tm.vec2,
        first_mm: tm.vec2,
        sample_mm: float,
        frequency_mhz: float,
        aperture: float,
        axial_sd: float,
        elevation_sd: float,
    ):
        planes = ti.static(THICK if rung == 2 else MIDDLE)
        for line in range(self.lines):
            start, direction = self.start[line], self.direction[line]
            for i in range(self.samples):
                self.real[line, i] = 0.0
            row, column = self.plane.pixel_near(start, pixel_mm, first_mm)
            linear = self.plane.map_of(row, column)
            near, rest = self.look(linear, row, column, start, planes, elevation_sd)
            loss_db, passed, amplitude = 0.0, 1.0, 1.0
            # An interface: its steps added up, their mean depth, how squarely it is met; what was before it, and where.
            steps, middle, squarely, thick = 0.0, 0.0, 0.0, 0.0
            before, loud_before, begins = near, amplitude, 0.0
            stride_mm = stride * sample_mm
            for k in range(self.samples // stride):
                place = start + ((k + 1) * stride_mm) * direction
                row, column = self.plane.pixel_near(place, pixel_mm, first_mm)
                linear_far = self.plane.map_of(row, column)
                far, rest_far = self.look(linear_far, row, column, place, planes, elevation_sd)
                # Beyond the CT nothing is known: nothing scatters, nothing reflects.
                if far.x < 1e-6:
                    far.x = near.x
                elif near.x < 1e-6:
                    near.x = far.x
                step = (far.x - near.x) / ti.max(far.x + near.x, 1e-6)
                if steps != 0.0 and (
                    step * steps <= 0.0 or ti.abs(step) < LEAST_REFLECTION or thick > self.interface_mm
                ):
                    reflection, depth = (near.x - before.x) / (near.x + before.x), middle / steps
                    # A blurred interface is one step at its middle, with the tissue before it up to there.
                    way_db = 2.0 * before.y * frequency_mhz * (depth - begins) / 10.0
                    loud = ti.abs(reflection) * loud_before * ti.exp(-way_db / DB) * squarely / steps
                    self.reflect(
                        rung, line, depth, loud * self.heard(line, depth, aperture), sample_mm, axial_sd
                    )
                    passed *= 1.0 - reflection * reflection
                    steps, middle, squarely, thick = 0.0, 0.0, 0.0, 0.0
                if steps == 0.0:
                    before, loud_before, begins = near, amplitude, k * stride_mm
                if ti.abs(step) >= LEAST_REFLECTION:
                    steps += step
                    middle += step * (k + 0.5) * stride_mm
                    square = self.squareness(0.5 * (rest + rest_far), linear_far, direction)
                    squarely += step * square
                    # Across the interface, however aslant the beam goes through it.
                    thick += square * square * stride_mm
                # There and back, over the stride in cm.
                loss_db += (near.y + far.y) * frequency_mhz * stride_mm / 10.0
                amplitude_far = passed * ti.exp(-loss_db / DB)
                heard = self.heard(line, (k + 0.5) * stride_mm, aperture)
                for j in range(stride):
                    t = (j + 0.5) / stride
                    loud = heard * tm.mix(amplitude, amplitude_far, t) * tm.mix(near.z, far.z, t)
                    # Without speckle: its mean square.
                    echo = tm.vec2(ti.static(1.0 if rung == 0 else 0.0), 0.0)
                    at, across = tm.mix(rest, rest_far, t), tm.mix(linear[:, 2], linear_far[:, 2], t)
                    for off, _, weight in ti.static(planes if rung > 0 else ()):
                        echo += weight * self.speckle.at(at + (off * elevation_sd) * across, axial_sd)
                    i = stride * k + j
                    self.real[line, i] = self.real[line, i] + loud * echo.x
                    self.imaginary[line, i] = loud * echo.y
                near, rest, linear, amplitude = far, rest_far, linear_far, amplitude_far

    @ti.func
    def heard(self, line, depth_mm, aperture):
        """Share of the elements that a line uses at a depth which touch tissue."""
        half = ti.min(ti.cast(depth_mm * aperture, ti.i32), self.lines)
        first, last = ti.max(line - half, 0), ti.min(line + half + 1, self.lines)
        return (self.touching[last] - self.touching[first]) / ti.cast(last - first, ti.f32)

    @ti.func
    def squareness(self, rest, linear, direction):
        """Root of the cosine between beam and the normal of an interface: Lambert's law for the intensity (Wein 2008)."""
        # The gradient at rest, carried into the deformed tissue by the inverse transpose of the deformation gradient.
        slope = linear[:, :3].transpose() @ self.tissue.slope(rest)
        # An interface thinner than the way from look to look has no slope halfway: taken as square.
        square, steep = 1.0, slope.norm()
        if steep > 1e-9:
            square = ti.sqrt(ti.abs(slope.x * direction.x + slope.y * direction.y) / steep)
        return square

    @ti.func
    def reflect(self, rung: ti.template(), line, depth_mm, loud, sample_mm, axial_sd):
        """Add the echo of an interface to a line, as wide as the pulse; what makes speckle louder leaves it as it is."""
        at, reach = depth_mm / sample_mm - 0.5, ti.ceil(3.5 * axial_sd / sample_mm, ti.i32)
        first = ti.max(ti.floor(at, ti.i32) - reach, 0)
        last = ti.min(ti.floor(at, ti.i32) + reach + 1, self.samples - 1)
        for i in range(first, last + 1):
            off = (i - at) * sample_mm / axial_sd
            echo = loud * ti.exp(-0.5 * off * off)
            if ti.static(rung > 0):
                echo /= self.loudness[i]
            self.real[line, i] = self.real[line, i] + echo

    @ti.kernel
    def _add(self):
        for line, sample in self.decibel:
            envelope = ti.abs(self.real[line, sample])
            self.decibel[line, sample] = DB * ti.log(envelope + SILENCE) + self.gain[sample]

    @ti.kernel
    def _spread(self):
        # Line by line at one depth, so that what neighbours share stays in the nearest cache.
        for packet, line in ti.ndrange(self.samples // LANES, self.lines):
            first = packet * LANES
            real, imaginary = Packet(0.0), Packet(0.0)
            half = self.half[packet]
            for k in range(-half, half + 1):
                # At the array's ends the lines beyond are taken as those before, mirrored.
                m = ti.abs(line + k)
                m = ti.min(m, 2 * (self.lines - 1) - m)
                # Conjugate, so that noise does not add up with itself; reflections are real.
                turned = 1.0 if m == line + k else -1.0
                weight = self.packet(self.weight, k + MOST_LINES, first)
                real += weight * self.packet(self.real, m, first)
                imaginary += turned * weight * self.packet(self.imaginary, m, first)
            loudness = Packet([self.loudness[first + i] for i in ti.static(range(LANES))])
            envelope = loudness * ti.sqrt(real * real + imaginary * imaginary)
            gain = Packet([self.gain[first + i] for i in ti.static(range(LANES))])
            decibel = DB * ti.log(envelope + SILENCE) + gain
            for i in ti.static(range(LANES)):
                self.decibel[line, first + i] = decibel[i]

    @ti.func
    def packet(self, field: ti.template(), row, first):
        return Packet([field[row, first + i] for i in ti.static(range(LANES))])

    @ti.kernel
    def _scan_convert(self, dynamic_range_db: float, picture: Picture):
        for row, column in self.source:
            at = self.source[row, column]
            grey = 0.0
            if at.x >= -0.5:
                x, y = tm.clamp(at.x, 0.0, self.lines - 1.001), tm.clamp(at.y, 0.0, self.samples - 1.001)
                line, sample = ti.cast(x, ti.i32), ti.cast(y, ti.i32)
                along = y - sample
                low = tm.mix(self.decibel[line, sample], self.decibel[line, sample + 1], along)
                high = tm.mix(self.decibel[line + 1, sample], self.decibel[line + 1, sample + 1], along)
                grey = 255.0 * (tm.mix(low, high, x - line) / dynamic_range_db + 1.0)
            picture[row, column] = ti.cast(tm.clamp(grey, 0.0, 255.0) + 0.5, ti.u8)


def source_of_pixels(probe: Probe, pixels: int) -> np.ndarray:
    """Line and sample, as fractions of indices, of each pixel's centre (pixels, pixels, 2) float32; -1 outside the picture."""
    width, depth, above = probe.extent_mm
    u = (np.arange(pixels) + 0.5) / pixels * width - width / 2
    v = (np.arange(pixels) + 0.5) / pixels * depth - above
    line, along = probe.beam_coordinates(*np.meshgrid(u, v))
    within = (
        (line >= -0.5) & (line <= probe.number_of_scanlines - 0.5) & (along >= 0) & (along <= probe.depth_mm)
    )
    source = np.stack([line, along / probe.sample_mm - 0.5], axis=-1)
    return np.where(within[..., None], source, -1.0).astype(np.float32)
