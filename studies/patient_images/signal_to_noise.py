"""Speckle of renal cortex over the electronic noise, over depth, in closed form."""

import numpy as np

from ultrasound.acoustics import CORTEX_DB, acoustic_table
from ultrasound.probe import Probe
from ultrasound.pulse import DB_OF_NEPER, PATH_STEP

DEPTHS_MM = 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0
# The bar of the issue is at this depth.
BAR_DEPTH_MM = 50.0
DEEPEST_MM, STEP_MM = 300.0, 0.5


def snr_db(probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """Return the mean square of the speckle of cortex over that of the noise [dB] at depths (n,), in uniform
    cortex from the array on.

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
    """Return the depth at which speckle of cortex has the level of the noise [mm]; NaN where that is
    deeper than DEEPEST_MM.
    """
    depth = np.arange(0.0, DEEPEST_MM, STEP_MM)
    snr = snr_db(probe, depth)
    below = np.flatnonzero(snr <= 0)
    if len(below) == 0:
        return float("nan")
    last = int(below[0])
    return float(np.interp(0.0, -snr[max(last - 1, 0) : last + 1], depth[max(last - 1, 0) : last + 1]))
