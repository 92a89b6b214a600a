"""The echo picture: sound sent along each line through the deformed tissue, its echoes made into grey values.

1. ``Beams.touch``: which elements of the array touch tissue.
2. ``Beams.send``: along each line, where the tissue was at rest, what it reflects and scatters, and what is left of the sound.
3. ``_spread``: the point-spread function across the lines, then the envelope in dB, with gain and compensation over depth.
4. ``_scan_convert``: from lines and samples to the pixels of the picture.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import fill
from ultrasound.image_plane import Picture, PlaneInTissue
from ultrasound.point_spread import MOST_LINES, axial_sd_mm, elevation_sd_mm, lateral_weights
from ultrasound.probe import DETAIL_LEVELS, DetailLevel, Probe
from ultrasound.sampled_volume import SampledVolume
from ultrasound.scanline_echo import DB, Beams

# A probe's samples are a multiple of this.
LANES = 16
Packet = ti.types.vector(LANES, ti.f32)
# Samples from one look into the tissue to the next: the more, if they are no longer than a voxel, for so fast tissue changes.
STRIDES = (8, 4)
SILENCE = 1e-9


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
        tissue: SampledVolume,
        organ: SampledVolume,
        plane: PlaneInTissue,
        probe: Probe,
        voxel_mm: float,
        contact: str = "organ",
        contact_gap_mm: float = 1.5,
        around: float | None = None,
    ) -> None:
        shape = probe.number_of_scanlines, probe.number_of_samples_per_scanline
        self.plane, self.voxel_mm = plane, voxel_mm
        self.beams = Beams(tissue, organ, plane, shape, voxel_mm, contact, contact_gap_mm, around)
        self.lines, self.samples = shape
        self.decibel = ti.field(ti.f32, shape)
        self.weight = ti.field(ti.f32, (2 * MOST_LINES + 1, self.samples))
        self.half = ti.field(ti.i32, self.samples // LANES)
        self.gain = ti.field(ti.f32, self.samples)
        self.source = ti.Vector.field(2, ti.f32, (plane.pixels, plane.pixels))
        self._tables_of: tuple | None = None

    def render(self, probe: Probe, detail_level: DetailLevel = "speckle") -> np.ndarray:
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
        self.beams.touch(*places)
        # A phased array sends every line with all of its elements.
        pitch = 0.0 if probe.transducer_geometry == "PHASED" else float(probe.line_spacing_mm(np.zeros(1))[0])
        aperture = 0.5 / (probe.f_number * pitch) if pitch else 1e6
        sd = axial_sd_mm(probe), elevation_sd_mm(probe)
        stride = STRIDES[0] if STRIDES[0] * probe.sample_mm <= self.voxel_mm else STRIDES[1]
        self.beams.send(
            DETAIL_LEVELS.index(detail_level),
            stride,
            *places,
            probe.sample_mm,
            probe.frequency_mhz,
            aperture,
            *sd,
        )
        if detail_level == "reflection":
            self._add()
        else:
            self._spread()
        picture = np.empty((self.plane.pixels, self.plane.pixels), np.uint8)
        self._scan_convert(probe.dyn_range_db, picture)
        return picture

    def _make_tables(self, probe: Probe) -> None:
        """What depends on the probe's settings alone, made anew when these change."""
        fill((self.gain, probe.gain_db()))
        fixed = probe.model_dump(exclude={"gain_percent", "dyn_range_db", "time_gain_compensation"})
        if self._tables_of == tuple(fixed.items()):
            return
        self._tables_of = tuple(fixed.items())
        start, direction = probe.scanlines()
        weights, half, loudness = lateral_weights(probe)
        fill(
            (self.beams.start, start),
            (self.beams.direction, direction),
            (self.beams.element, probe.elements()),
            (self.beams.loudness, loudness),
            (self.weight, weights),
            (self.half, half.reshape(-1, LANES).max(axis=1)),
            (self.source, source_of_pixels(probe, self.plane.pixels)),
        )

    @ti.kernel
    def _add(self):
        for line, sample in self.decibel:
            envelope = ti.abs(self.beams.real[line, sample])
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
                real += weight * self.packet(self.beams.real, m, first)
                imaginary += turned * weight * self.packet(self.beams.imaginary, m, first)
            loudness = Packet([self.beams.loudness[first + i] for i in ti.static(range(LANES))])
            envelope = loudness * ti.sqrt(real * real + imaginary * imaginary)
            gain = Packet([self.gain[first + i] for i in ti.static(range(LANES))])
            decibel = DB * ti.log(envelope + SILENCE) + gain
            for i in ti.static(range(LANES)):
                self.decibel[line, first + i] = decibel[i]

    @ti.func
    def packet(self, field: ti.template(), row, first):
        """LANES entries of a row of a field."""
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
