"""Speckle and contrast of a recorded phantom, beside what our B-mode image gives for a like probe.

The recording is of an endorectal curved array, BK 8848. Its geometry is that of PLUS's configuration for it
(PlusDeviceSet_fCal_BkProFocus_OpenIGTLinkTracker.xml of PlusLibData); frequency, bandwidth and aperture are
not stated.
"""

from typing import NamedTuple

import numpy as np

from studies.echo.echo_phantom import EchoPhantom
from studies.image_quality import (
    RAYLEIGH_SNR,
    contrast_db,
    correlation_length,
    gcnr,
    speckle_snr,
    without_depth_trend,
)
from studies.scanner.recordings import ScannerRow, rows_of
from ultrasound.probe import Probe

PART = "speckle"
RADIUS_MM, DEPTH_MM, HALF_SECTOR_DEG = 10.0, 50.0, 70.0
# Ours is a multiple of 16 samples.
LINES, SAMPLES = 358, 1728
# In the middle of the array's range, 4 to 12 MHz.
FREQUENCY_MHZ = 7.5
SEED, DRAWS = 20181029, 6


class SpeckleRegion(NamedTuple):
    """Scanlines and samples of a part of the recording."""

    name: str
    scanlines: slice
    samples: slice

    def of(self, signal: np.ndarray) -> np.ndarray:
        """Its part of a signal (scanlines, samples)."""
        return signal[self.scanlines, self.samples]


# As seen in the recording: even speckle without bright points.
SPECKLE = (
    SpeckleRegion("near the array, left", slice(30, 180), slice(60, 130)),
    SpeckleRegion("near the array, right", slice(180, 300), slice(60, 130)),
    SpeckleRegion("grey disc", slice(145, 215), slice(300, 400)),
)
# The grey disc, and the dark part beside it at the same depth.
INSIDE, OUTSIDE = SpeckleRegion("dark", slice(265, 300), slice(310, 390)), SPECKLE[2]


def probe_of(recorded_samples: int) -> Probe:
    """A probe with the geometry of the recording, where its scanlines have so many samples."""
    # PLUS counts the sector between the outermost scanlines, we between the outer edges of these.
    half_deg = HALF_SECTOR_DEG * LINES / (LINES - 1)
    return Probe(
        transducer_name="BK 8848, axial",
        transducer_geometry="CURVILINEAR",
        radius_start_mm=RADIUS_MM,
        theta_start_deg=-half_deg,
        theta_stop_deg=half_deg,
        number_of_scanlines=LINES,
        number_of_samples_per_scanline=SAMPLES,
        frequency_range_mhz=(4.0, 12.0),
        frequency_mhz=FREQUENCY_MHZ,
        depth_mm=DEPTH_MM * SAMPLES / recorded_samples,
        ringing_db=-200.0,
    )


def our_speckle(phantom: EchoPhantom) -> list[np.ndarray]:
    """Amplitudes (scanlines, samples) of even tissue, at several places."""
    phantom.fill(backscatter=0.1)
    return [phantom.amplitude(at) for at in np.random.default_rng(SEED).uniform(-200, 200, DRAWS)]


def _figures(probe: Probe, region: SpeckleRegion, amplitudes: list[np.ndarray]) -> tuple[float, float, float]:
    """SNR, lateral and axial correlation length [mm] of a region, the means over images."""
    parts = [without_depth_trend(region.of(amplitude)) for amplitude in amplitudes]
    depth_mm = (region.samples.start + region.samples.stop) / 2 * probe.sample_mm
    spacing = float(probe.line_spacing_mm(np.array([depth_mm]))[0])
    snr = np.mean([speckle_snr(part) for part in parts])
    lateral, axial = (np.mean([correlation_length(part, axis) for part in parts]) for axis in (0, 1))
    return float(snr), float(lateral) * spacing, float(axial) * probe.sample_mm


def measurements(iq: np.ndarray, phantom: EchoPhantom) -> list[ScannerRow]:
    """Lines of the table, of the recorded IQ signal (scanlines, samples) and our images of a like probe."""
    probe, amplitude, simulated = phantom.probe, np.abs(iq), our_speckle(phantom)
    ours = f"ours: {FREQUENCY_MHZ:g} MHz, {probe.bandwidth_percent:g} %, f/{probe.f_number:g}"
    not_stated = f"{ours}; the recording's are not stated"
    quantities = (
        ("SNR", "", f"Rayleigh: {RAYLEIGH_SNR:.2f}"),
        ("lateral correlation length", "mm", not_stated),
        ("axial correlation length", "mm", not_stated),
    )
    lines: list[tuple] = []
    for region in SPECKLE:
        pairs = zip(*(_figures(probe, region, images) for images in ([amplitude], simulated)), strict=True)
        for (quantity, unit, note), pair in zip(quantities, pairs, strict=True):
            lines.append((f"{region.name}: {quantity}", *pair, unit, note))
    inside, outside = INSIDE.of(amplitude), OUTSIDE.of(amplitude)
    dark = "dark part beside the grey disc"
    lines.append((f"{dark}: contrast", contrast_db(inside, outside), None, "dB"))
    lines.append((f"{dark}: gCNR", gcnr(inside, outside)))
    return rows_of(PART, *lines)
