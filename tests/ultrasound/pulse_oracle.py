"""The pulse of an array of 75 % bandwidth, by sums over its spectrum: one cycle through a generalized
normal window.
"""

import numpy as np

NEPER_DB = 20 / np.log(10)


def spectrum(frequency_mhz: float) -> tuple[np.ndarray, np.ndarray]:
    share = np.arange(1, 20_000) / 10_000
    window = 2.0 ** -((np.abs(share - 1) / 0.375) ** (np.log(126) / np.log(2 / 0.75)))
    cycle = np.abs(np.sinc(share - 1) - np.sinc(share + 1))
    return share * frequency_mhz, window * cycle


def loss_db(path_db_mhz: np.ndarray, frequency_mhz: float, of: str = "speckle") -> np.ndarray:
    """What attenuation [dB/MHz, round trip] takes of the mean square of speckle, or of the peak of an
    "echo".
    """
    frequency, amplitude = spectrum(frequency_mhz)
    path = np.atleast_1d(path_db_mhz)
    power = 2 if of == "speckle" else 1
    left = [np.sum((amplitude * np.exp(-p / NEPER_DB * frequency)) ** power) for p in path]
    return -20 / power * np.log10(np.array(left) / np.sum(amplitude**power))


def fwhm_mm(path_db_mhz: float, frequency_mhz: float) -> float:
    """Full width at half maximum of the pulse's echo, from its envelope in time."""
    frequency, amplitude = spectrum(frequency_mhz)
    amplitude = amplitude * np.exp(-path_db_mhz / NEPER_DB * frequency)
    time = np.linspace(0, 3 / frequency_mhz, 3001)
    envelope = np.abs(np.exp(2j * np.pi * np.outer(time, frequency[::20])) @ amplitude[::20])
    return 2 * np.interp(-0.5, -envelope / envelope[0], time) * 1.54 / 2
