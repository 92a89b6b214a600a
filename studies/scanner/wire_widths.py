"""Width of the wires of PLUS's N-wire phantom over depth, beside the width of our beam.

The recording states millimetres per pixel and where the image is in the picture; array, frequency, focus and
grey map are not stated.
"""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.ndimage import find_objects, label

from studies.scanner.recordings import RecordingError, ScannerRow, rows_of
from ultrasound.beam import lateral_profiles
from ultrasound.probe import Probe
from ultrasound.sweep import load_constants

PART = "wires"
# A wire is so bright, and so many pixels; a picture shows all six.
LEAST_GREY, LEAST_PIXELS, WIRES = 60, 8, 6
DEPTH_STEP_MM, LEAST_WIRES = 3.0, 10
# Levels of our beam at which its width is given.
LEVELS_DB = (-6.0, -20.0, -40.0)


@dataclass(frozen=True)
class PixelSize:
    """Size of a pixel [mm], lateral and axial, and the row of the array's face."""

    lateral_mm: float
    axial_mm: float
    face_row: float


def pixel_size(configuration: Path) -> PixelSize:
    """What a PLUS configuration states: ImageToProbe and the upper edge of its clip rectangle.

    Raises SweepError, RecordingError.
    """
    matrix = load_constants(configuration)["ImageToProbe"]
    corner = ElementTree.parse(configuration).find("VolumeReconstruction")
    if corner is None or "ClipRectangleOrigin" not in corner.attrib:
        raise RecordingError(f"{configuration.name}: expected VolumeReconstruction with ClipRectangleOrigin")
    lateral, axial = np.linalg.norm(matrix[:3, :2], axis=0)
    return PixelSize(float(lateral), float(axial), float(corner.attrib["ClipRectangleOrigin"].split()[1]))


def wire_widths(images: np.ndarray, size: PixelSize) -> tuple[np.ndarray, np.ndarray]:
    """Depth and lateral width at half of its grey value [mm], each (n,), of each wire across the plane: the
    outer two of each row, as the wires in the middle pass aslant. Images are (n, rows, columns).
    """
    depths, widths = [], []
    for image in images:
        wires = _wires_of(image)
        if len(wires) != WIRES:
            continue
        wires.sort(key=lambda place: place[1])
        for row, column in (*wires[:2], *wires[-2:]):
            depths.append((row + 0.5 - size.face_row) * size.axial_mm)
            widths.append(_half_width(image[row].astype(float), column) * size.lateral_mm)
    return np.array(depths), np.array(widths)


def _wires_of(image: np.ndarray) -> list[tuple[int, int]]:
    """Row and column of the brightest pixel of each bright piece of an image."""
    pieces, _ = label(image > LEAST_GREY)
    places = []
    for number, box in enumerate(find_objects(pieces), start=1):
        within = pieces[box] == number
        if within.sum() >= LEAST_PIXELS:
            row, column = np.unravel_index(np.argmax(np.where(within, image[box], 0)), within.shape)
            places.append((int(row) + box[0].start, int(column) + box[1].start))
    return places


def _half_width(row: np.ndarray, peak: int) -> float:
    """Width [pixels] around a peak at half of its value."""
    half, ends = row[peak] / 2, []
    for step in (-1, 1):
        at = peak
        while 0 < at < len(row) - 1 and row[at] > half:
            at += step
        ends.append(at - step * (half - row[at]) / max(row[at - step] - row[at], 1e-9))
    return float(ends[1] - ends[0])


def beam_width_mm(probe: Probe, depth_mm: float, level_db: float) -> float:
    """Full width of our beam on the middle scanline at a level."""
    spacing = float(probe.line_spacing_mm(np.array([depth_mm]))[0])
    lag = np.linspace(0, 12.0 / spacing, 1201)
    profile = lateral_profiles(probe, (probe.number_of_scanlines - 1) / 2, np.array([depth_mm]), lag)[0]
    # The outermost place at which the beam has that level: side lobes count.
    above = int(np.flatnonzero(profile >= 10 ** (level_db / 20))[-1])
    return float(2 * lag[above] * spacing)


def measurements(depth_mm: np.ndarray, width_mm: np.ndarray, probe: Probe) -> list[ScannerRow]:
    """Lines of the table: the median width of the wires in steps of depth, and ours at several levels."""
    lines = []
    step = np.floor(depth_mm / DEPTH_STEP_MM).astype(int)
    for number in np.unique(step):
        if (step == number).sum() < LEAST_WIRES:
            continue
        middle = (number + 0.5) * DEPTH_STEP_MM
        recorded = float(np.median(width_mm[step == number]))
        ours = [beam_width_mm(probe, middle, level) for level in LEVELS_DB]
        others = zip(ours[1:], LEVELS_DB[1:], strict=True)
        text = ", ".join(f"{width:.2f} at {level:g} dB" for width, level in others)
        note = f"recorded: half of the grey value, whose map is not stated; ours: -6 dB ({text})"
        lines.append((f"lateral width at {middle:g} mm", recorded, ours[0], "mm", note))
    return rows_of(PART, *lines)
