"""Ring-down of an array in air: level over depth of a recording, and the law of
``ultrasound/reverberation.py: ringing`` fitted to it.

In air nothing but the array itself is recorded. Depth is counted in wavelengths of the carrier, which needs
no rate of sampling: the scanner stores as Q the signal of a quarter of the carrier's period later, so that
the delay between I and Q is the carrier's.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from studies.scanner.recordings import ScannerRow, rows_of
from ultrasound.probe import Probe
from ultrasound.pulse import DB_OF_NEPER
from ultrasound.reverberation import BANDS, FALL_IN_AIR, LENS, MORE_IN_AIR_DB

PART = "ring-down in air"
# Samples in which the recording is free of clipping, and ringing is above the noise; and those of noise alone
# behind them.
FITTED, NOISE = slice(160, 800), slice(900, 1100)
# Samples over which the level is averaged: less than half a period of the carrier.
AVERAGED = 5
# Starts of the search for the thickness of the lens [wavelengths] and for the phase of its bands.
LENSES, PHASES = np.arange(3.0, 9.0, 0.25), np.arange(0.0, 2 * np.pi, 1.2)


@dataclass(frozen=True)
class RingDown:
    """Level [dB] over depth [wavelengths], both (samples,); the fitted law: 1 / e length and lens in
    wavelengths, half of the depth of the bands, level at the face and of the noise [dB].
    """

    depth: np.ndarray
    level_db: np.ndarray
    cycles_per_sample: float
    fall: float
    lens: float
    bands: float
    phase: float
    start_db: float
    noise_db: float

    def fitted_db(self, depth: np.ndarray) -> np.ndarray:
        """Law's level [dB] at depths in wavelengths."""
        return _law_db((self.start_db, self.fall, self.lens, self.phase, self.bands), depth, self.noise_db)


def carrier_of(iq: np.ndarray) -> float:
    """Frequency [cycles per sample] of which the delay from I to Q (scanlines, samples) is a quarter of the
    period.

    The delay is the slope of the phase of their cross-spectrum over frequency.
    """
    window = np.hanning(iq.shape[1])
    in_phase, quadrature = (
        np.fft.rfft((part - part.mean(axis=1, keepdims=True)) * window) for part in (iq.real, iq.imag)
    )
    cross = (in_phase.conj() * quadrature).mean(axis=0)
    frequency = np.fft.rfftfreq(iq.shape[1])
    weight = np.where(np.abs(cross) > 0.1 * np.abs(cross).max(), np.abs(cross), 0.0)
    turn = (weight * frequency * np.angle(cross)).sum() / (weight * frequency**2).sum()
    return float(0.25 / (np.abs(turn) / (2 * np.pi)))


def fitted_ring_down(iq: np.ndarray, fitted: slice = FITTED, noise: slice = NOISE) -> RingDown:
    """Law that fits the IQ signal (scanlines, samples) of an array in air best, robustly, in dB."""
    carrier = carrier_of(iq[:, fitted])
    depth = (np.arange(iq.shape[1]) + 0.5) * carrier / 2
    power = np.convolve((np.abs(iq) ** 2).mean(axis=0), np.ones(AVERAGED) / AVERAGED, "same")
    level_db, noise_db = 10 * np.log10(power), float(10 * np.log10(power[noise].mean()))

    def residual(law: np.ndarray) -> np.ndarray:
        return _law_db(law, depth[fitted], noise_db) - level_db[fitted]

    least, most = [noise_db, 0.5, 2.0, -np.pi, 0.0], [noise_db + 120, 100.0, 12.0, 3 * np.pi, 0.49]
    starts = [(noise_db + 50, 8.0, lens, phase, 0.3) for lens in LENSES for phase in PHASES]
    fits = [least_squares(residual, start, bounds=(least, most), loss="soft_l1") for start in starts]
    start_db, fall, lens, phase, bands = min(fits, key=lambda fit: fit.cost).x
    return RingDown(depth, level_db, carrier, fall, lens, bands, phase, start_db, noise_db)


def _law_db(law: "np.ndarray | tuple[float, ...]", depth: np.ndarray, noise_db: float) -> np.ndarray:
    start_db, fall, lens, phase, bands = law
    shape = 1 - bands + bands * np.cos(2 * np.pi * depth / lens - phase)
    level_db = start_db + DB_OF_NEPER * (np.log(shape) - depth / fall)
    return 10 * np.log10(10 ** (level_db / 10) + 10 ** (noise_db / 10))


def measurements(ring: RingDown, probe: Probe) -> list[ScannerRow]:
    """Lines of the table; ours beside them, the level above the noise that of a probe."""
    ours_db = probe.ringing_db + MORE_IN_AIR_DB - probe.noise_before_gain_db
    visible = float(ring.depth[FITTED][np.flatnonzero(ring.level_db[FITTED] > ring.noise_db + 6)[-1]])
    clips = "extrapolated: nearer than 12 wavelengths the recording clips"
    sampled = "from the delay between I and Q; rate of sampling not stated"
    return rows_of(
        PART,
        ("falls to 1/e in", ring.fall, FALL_IN_AIR, "wavelengths", "TGC not stated"),
        ("period of its bands", ring.lens, LENS, "wavelengths"),
        ("bands: half of their depth", ring.bands, BANDS, "of the amplitude"),
        ("at the face, above the noise", ring.start_db - ring.noise_db, ours_db, "dB", clips),
        ("within 6 dB of the noise from", visible, None, "wavelengths"),
        ("carrier", ring.cycles_per_sample, None, "cycles per sample", sampled),
    )
