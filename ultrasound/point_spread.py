"""The point-spread function of a probe: axial, lateral and elevational.

Separable: exp(-(x^2 / sa^2 + y^2 / sl^2 + z^2 / se^2) / 2), the lateral width growing away from the focus,
sl(z) = sf sqrt(1 + ((z - zf) / zR)^2), with sf from the f-number (full width at half maximum = wavelength * f-number).
"""

import numpy as np

from ultrasound.probe import FWHM_OF_SD, Probe

# Half width of the lateral kernel, in standard deviations and at most in scanlines.
HALF_WIDTH_SD, MAX_HALF_WIDTH = 2.5, 24


def axial_sd_mm(probe: Probe) -> float:
    """Return the axial width [mm]: a pulse of n cycles is n wavelengths long, its echo half of that."""
    return probe.pulse_cycles * probe.wavelength_mm / 2 / FWHM_OF_SD


def lateral_sd_mm(probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """Return the lateral width at depths [mm]."""
    at_focus = probe.wavelength_mm * probe.f_number / FWHM_OF_SD
    return at_focus * np.sqrt(1 + ((depth_mm - probe.focus_mm) / probe.focal_zone_mm) ** 2)


def elevation_sd_mm(probe: Probe) -> float:
    """Return the elevational width [mm], the same at all depths."""
    return probe.elevation_width_mm / FWHM_OF_SD


def lateral_weights(probe: Probe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lateral kernel at each sample.

    Weights (2 MAX_HALF_WIDTH + 1, samples), of sum 1; the half width in scanlines (samples,); and the speckle gain (samples,), which
    restores unit mean square of noise with the axial width's correlation.
    """
    depth = (np.arange(probe.number_of_samples_per_scanline) + 0.5) * probe.sample_mm
    axial, spacing = axial_sd_mm(probe), probe.line_spacing_mm(depth)
    # The noise already has the width of the pulse in every direction.
    width = np.sqrt(np.maximum(lateral_sd_mm(probe, depth) ** 2 - axial**2, 0)) / np.maximum(spacing, 1e-6)
    half = np.clip(np.ceil(HALF_WIDTH_SD * width), 0, MAX_HALF_WIDTH).astype(np.int32)
    lines = np.arange(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1)[:, None]
    weights = np.exp(-0.5 * (lines / np.maximum(width, 0.05)) ** 2) * (np.abs(lines) <= half)
    weights /= weights.sum(axis=0)
    energy = np.zeros(len(depth))
    for lag in range(len(lines)):
        together = (weights[: len(lines) - lag] * weights[lag:]).sum(axis=0) * (1 if lag == 0 else 2)
        energy += together * np.exp(-((lag * spacing) ** 2) / (4 * axial**2))
    return weights, half, 1 / np.sqrt(energy)
