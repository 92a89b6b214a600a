"""The pulse: its spectrum, and how attenuation changes it. NumPy.

Attenuation rises with frequency. So the centre frequency of a pulse falls on its way, it loses less than one
of that frequency alone, and it becomes longer.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

SOUND_MM_US = 1.54
FWHM_OF_SD = float(np.sqrt(8 * np.log(2)))
DB_OF_NEPER = float(20 / np.log(10))
# Attenuation of the round trip [Np/MHz] at the entries of the tables.
PATH_STEP, PATH_ENTRIES = 0.05, 256
# Lengths, which change little, are computed at one entry of so many.
LENGTHS_EVERY = 3


@dataclass(frozen=True)
class AttenuatedPulse:
    """How attenuation over the path changes the pulse; each (PATH_ENTRIES,), at multiples of PATH_STEP
    [Np/MHz].

    ``speckle_db`` is the change of the mean square of speckle, ``echo_db`` of the peak of an interface's
    echo. ``axial_sd_mm`` is the length of that echo, as an SD of the same full width at half maximum;
    ``speckle_sd_mm`` that of speckle, which correlates by 1/2 in intensity where exp(-d^2 / (2 SD^2)) does.
    """

    speckle_db: np.ndarray
    echo_db: np.ndarray
    axial_sd_mm: np.ndarray
    speckle_sd_mm: np.ndarray


def pulse_spectrum(frequency_mhz: float, bandwidth_percent: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [MHz] and amplitudes of the echo of one cycle, transmitted and received by an array of
    limited bandwidth.

    The bandwidth is a generalized normal window of -6 dB width, zero at 0 and twice the centre frequency
    (Garcia 2022, SIMUS, Comput Methods Programs Biomed 218, 106726).
    """
    frequency = np.linspace(0, 2 * frequency_mhz, 1025)[1:-1]
    share = bandwidth_percent / 100
    power = np.log(126) / np.log(2 / share)
    window = np.exp(-np.log(2) * (2 * np.abs(frequency / frequency_mhz - 1) / share) ** power)
    cycle = np.sinc(frequency / frequency_mhz - 1) - np.sinc(frequency / frequency_mhz + 1)
    return frequency, window * np.abs(cycle)


@lru_cache(32)
def attenuated_pulse(frequency_mhz: float, bandwidth_percent: float) -> AttenuatedPulse:
    """The tables of a pulse."""
    frequency, amplitude = pulse_spectrum(frequency_mhz, bandwidth_percent)
    path = PATH_STEP * np.arange(PATH_ENTRIES)[:, None]
    # The frequency that is attenuated least is divided out, as very small numbers lose digits.
    spectrum = amplitude * np.exp(-path * (frequency - frequency[0]))
    square, peak = (spectrum**2).sum(axis=1), spectrum.sum(axis=1)
    lowest_db = -DB_OF_NEPER * path[:, 0] * frequency[0]
    return AttenuatedPulse(
        10 * np.log10(square / square[0]) + lowest_db,
        20 * np.log10(peak / peak[0]) + lowest_db,
        2 * _lengths_mm(0.5, spectrum, frequency) / FWHM_OF_SD,
        _lengths_mm(0.5**0.5, spectrum**2, frequency) / np.sqrt(2 * np.log(2)),
    )


def _lengths_mm(level: float, spectrum: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """The distance (PATH_ENTRIES,) at which the envelope falls to a level; half of the round trip is the
    distance.
    """
    entries = np.arange(0, PATH_ENTRIES, LENGTHS_EVERY)
    at_entries = [_time_to(level, spectrum[entry], frequency) * SOUND_MM_US / 2 for entry in entries]
    return np.interp(np.arange(PATH_ENTRIES), entries, at_entries)


def _time_to(level: float, spectrum: np.ndarray, frequency: np.ndarray) -> float:
    """The time [us] at which the envelope of a spectrum's signal falls to a level of its peak."""
    count = 1 << 13
    envelope = np.abs(np.fft.fft(spectrum, count))
    limit = level * envelope[0]
    below = int(np.argmax(envelope < limit))
    at = below - (limit - envelope[below]) / (envelope[below - 1] - envelope[below])
    return float(at / count / (frequency[1] - frequency[0]))
