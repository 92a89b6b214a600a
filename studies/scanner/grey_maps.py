"""Grey values of real pictures: their histograms, and the grey map from the recorded amplitude, where that is
recorded too.

Both recordings with an IQ signal have pictures that PLUS made, not the scanner: grey = scale times the fourth
root of the amplitude, then scan conversion (vtkPlusRfToBrightnessConvert.cxx), so that they show PLUS's grey
map.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from sim.fields import fill
from studies.echo.echo_phantom import EchoPhantom
from studies.image_quality import grey_figures
from studies.scanner.recorded_speckle import DEPTH_MM, HALF_SECTOR_DEG, RADIUS_MM
from studies.scanner.recordings import ScannerRow, rows_of

PART = "grey values"
# Of the picture of the curved array (PLUS's configuration): mm per pixel, and the pixel at the middle of the
# array's face.
PIXEL_MM, FACE_PIXEL = 0.15, (53, 300)
# Of the picture of the linear array, by registration: rows and columns of the image; sample of its first row,
# samples per row.
LINEAR_ROWS, LINEAR_COLUMNS = slice(15, 285), slice(25, 215)
LINEAR_FIRST_SAMPLE, LINEAR_SAMPLES_PER_ROW = 23.0, 7.56
# Grey values at the ends of the range are cut off; a step of the amplitude [dB].
FITTED_GREY, STEP_DB = (5.0, 250.0), 2.0
# Our picture: dynamic range, and pixels to each side.
DYNAMIC_RANGE_DB, PIXELS = 60.0, 768


@dataclass(frozen=True)
class GreyMap:
    """Median grey at steps of the amplitude [dB], both (n,); the fits: grey = scale amplitude^exponent, and
    linear in dB [grey per dB], each with its residual [grey].
    """

    amplitude_db: np.ndarray
    grey: np.ndarray
    exponent: float
    scale: float
    power_residual: float
    slope: float
    linear_residual: float

    def power(self) -> np.ndarray:
        """Grey (n,) of the fitted power."""
        return self.scale * 10 ** (self.amplitude_db / 20 * self.exponent)


def fitted_grey_map(amplitude: np.ndarray, grey: np.ndarray) -> GreyMap:
    """Grey map of pixels (n,)."""
    used = (amplitude > 0) & (grey > FITTED_GREY[0]) & (grey < FITTED_GREY[1])
    decibel, grey = 20 * np.log10(amplitude[used]), grey[used]
    step = np.floor(decibel / STEP_DB).astype(int)
    steps = [step == number for number in np.unique(step) if (step == number).sum() >= 20]
    middle, median = (np.array([np.median(values[at]) for at in steps]) for values in (decibel, grey))
    power, linear = np.polyfit(middle, np.log(median), 1), np.polyfit(middle, median, 1)
    power_residual = _rms(np.exp(np.polyval(power, middle)) - median)
    linear_residual = _rms(np.polyval(linear, middle) - median)
    exponent, scale = float(power[0] * 20 / np.log(10)), float(np.exp(power[1]))
    return GreyMap(middle, median, exponent, scale, power_residual, float(linear[0]), linear_residual)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def curved_source(picture: np.ndarray, lines: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Scanline and sample, fractional, of the pixels of the curved array's picture, nan beyond the sector."""
    row, column = np.indices(picture.shape)
    depth = RADIUS_MM + (row - FACE_PIXEL[0]) * PIXEL_MM
    # PLUS has the middle half a pixel to the left.
    lateral = (column - FACE_PIXEL[1] + 0.5) * PIXEL_MM
    sample = (np.hypot(lateral, depth) - RADIUS_MM) * samples / DEPTH_MM
    line = (np.degrees(np.arctan2(lateral, depth)) / HALF_SECTOR_DEG + 1) / 2 * (lines - 1)
    within = (sample >= 0) & (sample < samples - 1) & (line >= 0) & (line < lines - 1)
    return np.where(within, line, np.nan), np.where(within, sample, np.nan)


def linear_source(lines: int) -> tuple[np.ndarray, np.ndarray]:
    """Scanline and sample of each pixel of the linear array's image, each (rows, columns)."""
    rows = np.arange(LINEAR_ROWS.stop - LINEAR_ROWS.start)
    columns = np.arange(LINEAR_COLUMNS.stop - LINEAR_COLUMNS.start)
    sample = LINEAR_FIRST_SAMPLE + LINEAR_SAMPLES_PER_ROW * rows
    line = columns / (len(columns) - 1) * (lines - 1)
    at_sample, at_line = np.meshgrid(sample, line, indexing="ij")
    return at_line, at_sample


def root_at(amplitude: np.ndarray, line: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Amplitudes at fractional scanlines and samples.

    Interpolated is the fourth root, whose speckle has no deep gaps.
    """
    return map_coordinates(amplitude**0.25, [line, sample], order=1) ** 4


def our_picture(amplitude: np.ndarray, phantom: EchoPhantom) -> np.ndarray:
    """Picture (rows, columns) uint8 that our log compression and scan conversion make of recorded amplitudes
    (scanlines, samples) of the phantom's probe.
    """
    probe = phantom.probe.model_copy(update={"dyn_range_db": DYNAMIC_RANGE_DB, "grey_map": "linear"})
    phantom.amplitude(probe=probe)
    # White is what a hundredth of the samples exceed.
    decibel = 20 * np.log10(np.maximum(amplitude, 1e-9) / np.percentile(amplitude, 99))
    fill((phantom.bmode.decibel, decibel[:, : probe.number_of_samples_per_scanline]))
    return phantom.bmode.scan_converted(probe)


def on_pixels_of(ours: np.ndarray, phantom: EchoPhantom, picture: np.ndarray) -> np.ndarray:
    """Our picture of the curved array at the pixels of PLUS's, 0 outside."""
    width, depth, above = phantom.probe.extent_mm
    row, column = np.indices(picture.shape)
    v, u = (row - FACE_PIXEL[0]) * PIXEL_MM, (column - FACE_PIXEL[1] + 0.5) * PIXEL_MM
    at = [(v + above) / depth * ours.shape[0] - 0.5, (u + width / 2) / width * ours.shape[1] - 0.5]
    return map_coordinates(ours.astype(float), at, order=1, cval=0.0)


def map_lines(name: str, grey_map: GreyMap) -> list[ScannerRow]:
    """Lines of the table of a grey map."""
    note = "PLUS's map, not the scanner's: grey = scale amplitude^exponent"
    slope = f"{grey_map.slope:.2f} grey per dB"
    return rows_of(
        PART,
        (f"{name}: grey map, exponent of the amplitude", grey_map.exponent, None, "", note),
        (f"{name}: grey map, scale", grey_map.scale, None, "grey", note),
        (f"{name}: residual of that map", grey_map.power_residual, None, "grey"),
        (f"{name}: residual of a map linear in dB", grey_map.linear_residual, None, "grey", slope),
    )


def histogram_lines(name: str, image: np.ndarray, note: str = "") -> list[ScannerRow]:
    """Median and 90th percentile of a picture's part."""
    figures = zip(("median", "90th percentile"), grey_figures(image), strict=True)
    return rows_of(PART, *((f"{name}: {figure}", value, None, "grey", note) for figure, value in figures))
