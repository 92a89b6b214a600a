"""The B-mode image: the echo signal of each scanline through the deformed tissue, converted to grey values.

1. ``Scanlines.find_contact``: which elements of the array are in contact.
2. ``Scanlines.simulate``: reflection, scattering and attenuation along each scanline.
3. ``_spread``: the point-spread function across the scanlines, then the envelope in dB, with gain and TGC.
4. ``_scan_convert``: from scanlines and samples to the pixels of the image.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import fill
from ultrasound.image_plane import Picture, PlaneInTissue
from ultrasound.point_spread import MAX_HALF_WIDTH, axial_sd_mm, elevation_sd_mm, lateral_weights
from ultrasound.probe import DETAIL_LEVELS, DetailLevel, Probe
from ultrasound.sampled_volume import SampledVolume
from ultrasound.scanline_echo import DB, Scanlines

# A probe's samples are a multiple of this.
LANES = 16
Packet = ti.types.vector(LANES, ti.f32)
# Samples between two tissue samples: the larger stride where it is no longer than a voxel.
STRIDES = (8, 4)
NOISE_FLOOR = 1e-9


@ti.data_oriented
class BMode:
    """B-mode images of an image plane in tissue.

    ``tissue`` is a volume (.., 3) of impedance, attenuation and backscatter (``acoustics.properties``), ``organ`` the signed
    distance from the organ's surface [mm], both at rest. An element transmits only in contact: with the organ, nearer than
    ``contact_gap_mm``, or, where ``contact`` is "tissue", with anything but gas. ``around`` is the impedance [MRayl] of all that is
    outside the organ; None for what the CT shows there.
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
        self.scanlines = Scanlines(tissue, organ, plane, shape, voxel_mm, contact, contact_gap_mm, around)
        self.lines, self.samples = shape
        self.decibel = ti.field(ti.f32, shape)
        self.weight = ti.field(ti.f32, (2 * MAX_HALF_WIDTH + 1, self.samples))
        self.half = ti.field(ti.i32, self.samples // LANES)
        self.gain = ti.field(ti.f32, self.samples)
        self.source = ti.Vector.field(2, ti.f32, (plane.pixels, plane.pixels))
        self._table_settings: tuple | None = None

    def render(self, probe: Probe, detail_level: DetailLevel = "speckle") -> np.ndarray:
        """Return grey values (pixels, pixels) uint8 of the plane located last; ``decibel`` holds its scanlines.

        Raises ValueError for a probe with other numbers of scanlines or samples.
        """
        if (probe.number_of_scanlines, probe.number_of_samples_per_scanline) != (self.lines, self.samples):
            raise ValueError(
                f"{probe.number_of_scanlines} scanlines of {probe.number_of_samples_per_scanline} samples: this image "
                f"was made for {self.lines} of {self.samples}"
            )
        self._make_tables(probe)
        places = self.plane.pixel_mm, self.plane.first_mm
        self.scanlines.find_contact(*places)
        # A phased array transmits every scanline with all of its elements.
        pitch = 0.0 if probe.transducer_geometry == "PHASED" else float(probe.line_spacing_mm(np.zeros(1))[0])
        aperture = 0.5 / (probe.f_number * pitch) if pitch else 1e6
        sd = axial_sd_mm(probe), elevation_sd_mm(probe)
        stride = STRIDES[0] if STRIDES[0] * probe.sample_mm <= self.voxel_mm else STRIDES[1]
        self.scanlines.simulate(
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
        """Update the tables of the probe's settings, if these changed."""
        fill((self.gain, probe.gain_db()))
        fixed = probe.model_dump(exclude={"gain_percent", "dyn_range_db", "time_gain_compensation"})
        if self._table_settings == tuple(fixed.items()):
            return
        self._table_settings = tuple(fixed.items())
        start, direction = probe.scanlines()
        weights, half, speckle_gain = lateral_weights(probe)
        fill(
            (self.scanlines.start, start),
            (self.scanlines.direction, direction),
            (self.scanlines.element, probe.elements()),
            (self.scanlines.speckle_gain, speckle_gain),
            (self.weight, weights),
            (self.half, half.reshape(-1, LANES).max(axis=1)),
            (self.source, source_of_pixels(probe, self.plane.pixels)),
        )

    @ti.kernel
    def _add(self):
        for line, sample in self.decibel:
            envelope = ti.abs(self.scanlines.real[line, sample])
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
                real += weight * self.packet(self.scanlines.real, m, first)
                imaginary += turned * weight * self.packet(self.scanlines.imaginary, m, first)
            speckle_gain = Packet([self.scanlines.speckle_gain[first + i] for i in ti.static(range(LANES))])
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
    """Return scanline and sample index, fractional, of each pixel's centre, (pixels, pixels, 2) float32; -1 outside the image."""
    width, depth, above = probe.extent_mm
    u = (np.arange(pixels) + 0.5) / pixels * width - width / 2
    v = (np.arange(pixels) + 0.5) / pixels * depth - above
    line, along = probe.beam_coordinates(*np.meshgrid(u, v))
    within = (
        (line >= -0.5) & (line <= probe.number_of_scanlines - 0.5) & (along >= 0) & (along <= probe.depth_mm)
    )
    source = np.stack([line, along / probe.sample_mm - 0.5], axis=-1)
    return np.where(within[..., None], source, -1.0).astype(np.float32)
