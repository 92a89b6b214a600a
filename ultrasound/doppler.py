"""Colour and power Doppler: the mean velocity towards the array, or the energy, of moving blood, over the
B-mode image.

Of each sample of a scanline, the autocorrelation of the echoes of successive pulses is computed from the
moments of what moves there, not from the pulses themselves (Kasai et al. 1985, IEEE Trans Sonics Ultrason 32,
458): its phase is that of the velocity, which aliases; a wall filter removes what is slow; the sample volume
averages it; noise is that of so many pulses.
"""

import zlib

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from ultrasound.acoustics import CORTEX_DB, tissue_table
from ultrasound.blood_flow import pulse_share
from ultrasound.bmode import BMode, padded_source
from ultrasound.lateral_kernel import LANES, MAX_HALF_WIDTH
from ultrasound.probe import DOPPLER_SETTINGS, DopplerMode, Probe
from ultrasound.propagation import Propagation
from ultrasound.pulse import DB_OF_NEPER, SOUND_MM_US
from ultrasound.sampled_volume import SampledVolume
from ultrasound.speckle import SIZE

# Pulses of one estimate. The noise of its band, and of these pulses, is so much below that of the B-mode
# image [dB].
ENSEMBLE, NARROW_BAND_DB = 10, 6.0
# Length of the sample volume along the beam [mm].
GATE_MM = 1.0
# Energy above the noise from which colour is shown, at a colour gain of 50 %, and what the gain changes [dB].
THRESHOLD_DB, GAIN_RANGE_DB = 6.0, 40.0
# Power Doppler shows energy over this range above the threshold [dB].
POWER_RANGE_DB = 25.0
# A B-mode image brighter than this share of white has priority over colour.
PRIORITY = 0.65
# Amplitude of blood in a vessel, relative to a perfect reflector.
BLOOD = 10 ** ((CORTEX_DB + tissue_table()["vessel"]["backscatter_db"]) / 20)
# Share of the energy of tissue at rest that the wall filter lets pass.
STOPPED = 2e-9
# A clamp at the hilum is so far from the organ.
CLAMP_MM = 5.0
# Scanlines from one independent value of noise to the next.
NOISE_LINES = 3.0
# Colours from no velocity to the limit of the scale, towards the array and away from it; and from no power to
# the most.
TOWARDS = np.array([[70, 0, 0], [205, 20, 10], [255, 150, 20], [255, 245, 120]], np.float32)
AWAY = np.array([[0, 0, 80], [20, 60, 205], [40, 160, 255], [150, 250, 255]], np.float32)
POWER = np.array([[60, 10, 20], [190, 50, 10], [250, 150, 30], [255, 240, 170]], np.float32)
STEPS = 64


def colour_table(stops: np.ndarray) -> np.ndarray:
    """The colours (STEPS + 1, 3) of a scale, between evenly spaced stops."""
    at = np.linspace(0, len(stops) - 1, STEPS + 1)
    return np.stack([np.interp(at, np.arange(len(stops)), stops[:, k]) for k in range(3)], axis=-1)


def scale_colours(mode: DopplerMode) -> np.ndarray:
    """The colours of a mode's scale from the top (n, 3) uint8."""
    top = POWER if mode == "power" else TOWARDS
    below = [] if mode == "power" else [colour_table(AWAY)]
    return np.concatenate([colour_table(top)[::-1], *below]).astype(np.uint8)


class Doppler:
    """Doppler images of the plane of a B-mode image, along the scanlines of ``sound``: its own or, where they
    are steered, others.

    ``flow`` (.., 5) has velocity [m/s] along the rest axes at the peak of systole, resistive index and
    amplitude of blood (``blood_flow.blood_flow``). ``moment`` (scanlines, samples) has, at the tissue
    samples, real and imaginary part of the autocorrelation, and the energy; ``mean`` is that of the sample
    volume, with noise.
    """

    def __init__(self, sound: Propagation, bmode: BMode, flow: SampledVolume) -> None:
        self.sound, self.bmode, self.flow = sound, bmode, flow
        self.lines, most = sound.lines, sound.most
        self.moment, self.mean = (zeros(self.lines, most, 3, within=1) for _ in range(2))
        # Energy that a scanline receives from its neighbours.
        self.weight = zeros(most, 2 * MAX_HALF_WIDTH + 1)
        self.half = zeros(most, kind=ti.i32)
        # Scanline and sample of each pixel.
        self.source = zeros(*bmode.source.shape, 2, within=1)
        self.colour = zeros(2, STEPS + 1, 3, within=1)
        self._table_settings: tuple | None = None

    def render(
        self, probe: Probe, grey: np.ndarray, mode: DopplerMode, time_s: float = 0.0, clamped: bool = False
    ) -> np.ndarray:
        """An image (rows, columns, 3) uint8: a B-mode image ``grey`` of the plane, with Doppler over it.

        The B-mode image must have been rendered last for the same probe. ``time_s`` is that of the heart.
        Blood of a clamped kidney rests; beyond the clamp it flows on.
        """
        self.estimate(probe, time_s, clamped)
        power = mode == "power"
        scales = (POWER, POWER) if power else (TOWARDS, AWAY)
        fill((self.colour, np.stack([colour_table(scale) for scale in scales])))
        threshold_db = THRESHOLD_DB - (probe.colour_gain_percent - 50) / 100 * GAIN_RANGE_DB
        threshold = noise_energy(probe) * 10 ** (threshold_db / 10)
        image = np.empty((*grey.shape, 3), np.uint8)
        least_share = probe.wall_filter_cm_s / probe.velocity_limit_cm_s
        self._paint(power, 1 / self.sound.stride_of(probe), threshold, least_share, grey, image)
        return image

    def estimate(self, probe: Probe, time_s: float = 0.0, clamped: bool = False) -> None:
        """Compute ``mean``, the moments over the sample volume, with noise."""
        steered = self._steered(probe)
        self._make_tables(steered)
        if self.sound is not self.bmode.sound:
            self.sound.run(steered, thick=False)
        limits = probe.velocity_limit_cm_s / 100, probe.wall_filter_cm_s / 100
        count, gate = self._sample_volume(probe)
        self._find_flow(count, int(clamped), pulse_share(time_s), *limits)
        # Noise changes with time, and with the plane.
        key = zlib.crc32(np.array([time_s, self.sound.plane.noise_key]).tobytes()) & 0x3FFFF
        self._average(count, gate, noise_energy(probe), float(ENSEMBLE) ** -0.5, key)

    def estimate_of(self, probe: Probe, moment: np.ndarray) -> None:
        """Compute ``mean`` from moments (scanlines, tissue samples, 3) of echoes (``autocorrelation``),
        which have their own noise.
        """
        self._make_tables(self._steered(probe))
        fill((self.moment, moment.astype(np.float32)))
        self._average(*self._sample_volume(probe), 0.0, 0.0, 0)

    def _sample_volume(self, probe: Probe) -> tuple[int, int]:
        """The number of tissue samples of a scanline, and half of those of the sample volume."""
        stride = self.sound.stride_of(probe)
        gate = max(round(GATE_MM / (2 * stride * probe.sample_mm)), 0)
        return probe.number_of_samples_per_scanline // stride + 1, gate

    def velocity_cm_s(self, probe: Probe) -> np.ndarray:
        """The velocity towards the array (scanlines, samples) [cm/s] of the last estimate, aliased."""
        real, imaginary, _ = np.moveaxis(array_of(self.mean), -1, 0)
        return np.arctan2(imaginary, real) / np.pi * probe.velocity_limit_cm_s

    def _steered(self, probe: Probe) -> Probe:
        """The probe with the scanlines of Doppler."""
        if self.sound is self.bmode.sound:
            return probe
        return probe.model_copy(update={"steering_deg": probe.colour_steering_deg})

    def _make_tables(self, probe: Probe) -> None:
        settings = probe.model_dump(exclude=set(DOPPLER_SETTINGS)), self.sound.plane.shape
        if self._table_settings == settings:
            return
        self._table_settings = settings
        # The middle class of the lateral kernel, squared.
        energy = array_of(self.bmode.weight)[0] ** 2
        packet = np.arange(self.sound.most) * self.sound.stride_of(probe) // LANES
        energy = energy[np.minimum(packet, len(energy) - 1)]
        energy /= np.maximum(energy.sum(axis=1, keepdims=True), 1e-9)
        lag = np.abs(np.arange(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1))
        fill(
            (self.weight, energy),
            (self.half, ((energy > 0.01) * lag).max(axis=1)),
            (self.source, padded_source(probe, self.sound.plane.shape, self.source.shape)),
        )
        if self.sound is not self.bmode.sound:
            self.sound.set_probe(probe, array_of(self.bmode.sound.slice_sd))

    @kernel
    def _find_flow(self, count: int, clamped: int, systole: float, limit: float, wall: float):
        """Set ``moment`` at each tissue sample: that of moving blood, behind the wall filter, and what is
        left of tissue.
        """
        for line, k in ti.ndrange(self.lines, count):
            flow = self.flow.sample(self.sound.rest[line, k])
            amplitude = self.sound.amplitude[line, k]
            tissue = (amplitude * self.sound.tissue[line, k].z) ** 2 * STOPPED
            velocity = tm.vec3(flow[0], flow[1], flow[2])
            pulsatile = 1.0 - flow[3] * (1.0 - systole)
            towards = pulsatile * self.towards_array(line, k, velocity)
            if clamped == 1 and self.sound.organ.sample(self.sound.rest[line, k]) < CLAMP_MM:
                towards = 0.0
            # What aliases is filtered as what it seems to be.
            seen = towards - 2.0 * limit * ti.round(towards / (2.0 * limit))
            energy = (amplitude * BLOOD * flow[4]) ** 2 * passed_by_wall_filter(seen / wall)
            if ti.static(self.sound.has_fluid):
                if self.sound.is_fluid(line, k):
                    energy = 0.0
            phase = tm.pi * towards / limit
            moment = energy * tm.vec2(ti.cos(phase), ti.sin(phase))
            self.moment[line, k] = tm.vec3(moment.x + tissue, moment.y, energy + tissue)

    @ti.func
    def towards_array(self, line, k, velocity):
        """The component towards the array of a velocity along the rest axes, carried by the deformed tissue.

        The tissue turns the velocity; its size stays.
        """
        size = velocity.norm()
        row, column = self.sound.plane.pixel_near(self.sound.place(line, k))
        linear = self.sound.plane.rest_from_plane(row, column)
        turned = ti.Matrix.cols([linear[:, 0], linear[:, 1], linear[:, 2]]).inverse() @ velocity
        direction = self.sound.direction[line]
        along = turned.x * direction.x + turned.y * direction.y
        return -along * size / ti.max(turned.norm(), 1e-9)

    @kernel
    def _average(self, count: int, gate: int, noise: float, scatter: float, key: int):
        for line, k in ti.ndrange(self.lines, count):
            total, half = tm.vec3(0.0), self.half[k]
            for m in range(-half, half + 1):
                there = tm.clamp(line + m, 0, self.lines - 1)
                for j in range(-gate, gate + 1):
                    sample = tm.clamp(k + j, 0, count - 1)
                    total += self.weight[k, m + MAX_HALF_WIDTH] * self.moment[there, sample]
            total /= 2.0 * gate + 1.0
            # The error of the mean of so many pulses, complex Gaussian.
            error = self.noise_at(line, k, key)
            error *= (total.z + noise) * scatter
            self.mean[line, k] = tm.vec3(
                total.x + error.x, total.y + error.y, total.z + noise + 0.5 * error.x
            )

    @ti.func
    def noise_at(self, line, k, key):
        """Noise (2,) of unit mean square that changes with the key, as wide as a beam."""
        at = line / NOISE_LINES
        first = ti.cast(at, ti.i32)
        # Another part of the block for each of its three axes' SIZE shifts.
        i, j, along = key + 17 * (k // SIZE), k + key // SIZE, first + key // (SIZE * SIZE)
        near, far = self.bmode.speckle.entry(i, j, along), self.bmode.speckle.entry(i, j, along + 1)
        return tm.mix(near, far, at - first)

    @kernel
    def _paint(
        self,
        power: ti.template(),
        per_stride: float,
        threshold: float,
        least_share: float,
        grey: ti.types.ndarray(ti.u8, ndim=2),
        image: ti.types.ndarray(ti.u8, ndim=3),
    ):
        columns = grey.shape[1]
        # The index of a row costs a division: one for several pixels.
        for row, packet in ti.ndrange(grey.shape[0], (columns + LANES - 1) // LANES):
            for column in range(packet * LANES, ti.min((packet + 1) * LANES, columns)):
                colour = tm.vec3(ti.cast(grey[row, column], ti.f32))
                at = self.source[row, column]
                if at.x >= -0.5 and colour.x < PRIORITY * 255.0:
                    mean = self.mean_at(at.x, (at.y + 0.5) * per_stride)
                    if mean.z > threshold:
                        share = ti.atan2(mean.y, mean.x) / tm.pi
                        if ti.abs(share) > least_share:
                            scale = ti.cast(share < 0.0, ti.i32)
                            if ti.static(power):
                                above_db = 0.5 * DB_OF_NEPER * ti.log(mean.z / threshold)
                                share, scale = above_db / POWER_RANGE_DB, 0
                            step = ti.round(tm.clamp(ti.abs(share), 0.0, 1.0) * STEPS, ti.i32)
                            colour = self.colour[scale, step]
                for k in ti.static(range(3)):
                    image[row, column, k] = ti.cast(colour[k] + 0.5, ti.u8)

    @ti.func
    def mean_at(self, line, k):
        """``mean`` at a fractional scanline and tissue sample."""
        x, y = tm.clamp(line, 0.0, self.lines - 1.001), tm.clamp(k, 0.0, self.sound.most - 1.001)
        i, j = ti.cast(x, ti.i32), ti.cast(y, ti.i32)
        low = tm.mix(self.mean[i, j], self.mean[i, j + 1], y - j)
        return tm.mix(low, tm.mix(self.mean[i + 1, j], self.mean[i + 1, j + 1], y - j), x - i)


def autocorrelation(iq: np.ndarray) -> np.ndarray:
    """The moments (.., 3) of the echoes (.., pulses) of successive pulses: real and imaginary part of the
    autocorrelation from one pulse to the next, and the energy (Kasai et al. 1985).

    Of a signal whose phase grows as the echo comes earlier, as demodulated by exp(-i w t), the phase is that
    of a velocity towards the array.
    """
    lagged = (iq[..., 1:] * iq[..., :-1].conj()).mean(axis=-1)
    return np.stack([lagged.real, lagged.imag, (np.abs(iq) ** 2).mean(axis=-1)], axis=-1)


def noise_energy(probe: Probe) -> float:
    """The energy of noise in an estimate, relative to the echo of a perfect reflector at the face."""
    return float(10 ** ((probe.noise_before_gain_db - NARROW_BAND_DB) / 10) / ENSEMBLE)


def doppler_shift_khz(probe: Probe, velocity_cm_s: float) -> float:
    """The Doppler shift of a velocity towards the array: 2 f v / c."""
    return 2 * probe.frequency_mhz * velocity_cm_s / 100 / SOUND_MM_US


@ti.func
def passed_by_wall_filter(share):
    """Energy that the wall filter lets pass of a velocity, in units of its limit: a Butterworth high-pass
    of fourth order.
    """
    eighth = share**8
    return eighth / (1.0 + eighth)
