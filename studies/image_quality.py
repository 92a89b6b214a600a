"""Figures of ultrasound images: statistics of speckle, contrast, grey values, speckle over noise. NumPy."""

import numpy as np

from ultrasound.acoustics import CORTEX_DB, acoustic_table
from ultrasound.probe import Probe
from ultrasound.pulse import DB_OF_NEPER, PATH_STEP

# Of the amplitude of fully developed speckle: mean over SD (Wagner 1983, IEEE Trans Sonics Ultrason 30, 156).
RAYLEIGH_SNR = float(np.sqrt(np.pi / (4 - np.pi)))
# Bins of the histograms that gCNR compares.
GCNR_BINS = 100


def speckle_snr(amplitude: np.ndarray) -> float:
    """Mean over SD of the amplitude of a region."""
    return float(amplitude.mean() / amplitude.std())


def correlation_length(amplitude: np.ndarray, axis: int) -> float:
    """Lag, in samples of an axis, at which a region's intensity correlates by 1/2; nan if it never does."""
    intensity = np.moveaxis(amplitude**2, axis, 0)
    intensity = intensity - intensity.mean()
    curve = [
        np.mean(intensity[: len(intensity) - lag] * intensity[lag:]) for lag in range(len(intensity) // 2)
    ]
    return first_at(np.arange(len(curve)), np.array(curve) / curve[0], 0.5)


def first_at(place: np.ndarray, values: np.ndarray, level: float) -> float:
    """The first place (n,) at which falling values (n,) reach a level, linear in between; nan if never."""
    below = np.flatnonzero(values <= level)
    if len(below) == 0:
        return float("nan")
    around = slice(max(int(below[0]) - 1, 0), int(below[0]) + 1)
    return float(np.interp(-level, -values[around], place[around]))


def without_depth_trend(amplitude: np.ndarray) -> np.ndarray:
    """Amplitudes (scanlines, samples) over the exponential of depth that attenuation and TGC leave."""
    sample = np.arange(amplitude.shape[1])
    level = np.polyfit(sample, np.log((amplitude**2).mean(axis=0)) / 2, 1)
    return amplitude / np.exp(np.polyval(level, sample))


def contrast_db(inside: np.ndarray, outside: np.ndarray) -> float:
    """Mean intensity of amplitudes inside a lesion over that outside [dB]."""
    return float(10 * np.log10((inside**2).mean() / (outside**2).mean()))


def gcnr(inside: np.ndarray, outside: np.ndarray) -> float:
    """Generalized contrast-to-noise ratio of amplitudes: 1 - overlap of their distributions
    (Rodriguez-Molares 2020, IEEE TUFFC 67, 745, equation 10). A monotonic grey map does not change it; the
    histograms are of logarithms, whose bins are alike.
    """
    logs = [np.log(np.maximum(part.ravel(), np.finfo(float).tiny)) for part in (inside, outside)]
    edges = np.histogram_bin_edges(np.concatenate(logs), GCNR_BINS)
    shares = [np.histogram(part, edges)[0] / part.size for part in logs]
    return float(1 - np.minimum(*shares).sum())


def grey_figures(image: np.ndarray) -> tuple[float, float]:
    """Median and 90th percentile of grey values."""
    median, most = np.percentile(image, [50, 90])
    return float(median), float(most)


NOISE_DEPTHS_MM = 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0
DEEPEST_MM, STEP_MM = 300.0, 0.5


def snr_db(probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """Mean square of the speckle of cortex over that of the noise [dB] at depths (n,), in uniform cortex from
    the array on.

    The level of its speckle, less what a pulse loses on the round trip (``AttenuatedPulse.speckle_db``), less
    ``Probe.noise_before_gain_db``; no loss at interfaces, no elements without contact. Beam and gain change
    signal and noise alike, or not at all.
    """
    _, attenuation, level_db, _ = acoustic_table("cortex")
    path = 2 * attenuation * np.asarray(depth_mm, float) / 10 / DB_OF_NEPER
    loss = probe.pulse.speckle_db
    lost = np.interp(path, PATH_STEP * np.arange(len(loss)), loss)
    return CORTEX_DB + level_db + lost - probe.noise_before_gain_db


def depth_of_noise_mm(probe: Probe) -> float:
    """Depth at which speckle of cortex has the level of the noise [mm]; NaN if deeper than DEEPEST_MM."""
    depth = np.arange(0.0, DEEPEST_MM, STEP_MM)
    return first_at(depth, snr_db(probe, depth), 0.0)
