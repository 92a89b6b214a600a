"""Motion capture of a clamped beam: recordings, deflection, frequency and damping."""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import OptimizeWarning, curve_fit
from scipy.signal import find_peaks

from errors import UserError
from scenes.folder_files import entries_of
from studies.number_table import read_numbers

COLUMNS = (
    "t_s",
    *(f"tip{k}_{axis}_m" for k in (1, 2, 3) for axis in "xyz"),
)
# The capture's x axis points up. A tip that has fallen by this distance was released.
UP = 0
FALLEN_MM = 0.5
# Frames averaged before the release and at rest.
HELD_FRAMES = 10
REST_FRAMES = 50
# The frequency is fitted in windows of WINDOW_PERIODS, one period apart; LEAST_SWING separates peaks from
# noise.
WINDOW_PERIODS = 2.0
WINDOWS = 3
LEAST_SWING = 0.1


class BeamError(UserError):
    """A fault of the recordings or the beam; the message is one line."""


@dataclass(frozen=True)
class Capture:
    """One recording: time_s (n,), tips_mm (n, 3 markers, 3) [mm]; load_g hangs at the tip."""

    name: str
    load_g: float
    time_s: np.ndarray
    tips_mm: np.ndarray

    def height_mm(self) -> np.ndarray:
        """Mean height (n,) [mm] of the tip markers above their position before the release."""
        height = self.tips_mm[:, :, UP].mean(axis=1)
        return height - height[:HELD_FRAMES].mean()

    def release(self) -> int:
        """The frame before the tip falls."""
        return int(np.argmax(self.height_mm() < -FALLEN_MM)) - 1

    def final_mm(self) -> np.ndarray:
        """Displacement (3, 3) [mm] of the tip markers from before the release to rest."""
        return self.tips_mm[-REST_FRAMES:].mean(axis=0) - self.tips_mm[:HELD_FRAMES].mean(axis=0)


@dataclass(frozen=True)
class Oscillation:
    """First frequency [Hz], its spread over the windows [Hz], and the damping ratio."""

    hz: float
    error_hz: float
    damping_ratio: float


def load_captures(folder: Path) -> list[Capture]:
    """All recordings of a folder, lightest load first. Raises BeamError."""
    paths = [path for path in entries_of(Path(folder)) if path.suffix == ".csv"]
    if not paths:
        raise BeamError(f"{folder}: holds no recordings (*.csv)")
    return sorted((read_capture(path) for path in paths), key=lambda capture: (capture.load_g, capture.name))


def read_capture(path: Path) -> Capture:
    """One recording; its name gives the load, such as ``beam_gravity_a`` or ``beam_load52_a``.

    Raises BeamError.
    """
    load = re.search(r"load(\d+)", path.stem)
    if load is None and "gravity" not in path.stem:
        raise BeamError(f"{path}: its name has neither 'gravity' nor 'load' and grams, such as load52")
    table, _ = read_numbers(path, COLUMNS, BeamError)
    if len(table) < HELD_FRAMES + REST_FRAMES:
        raise BeamError(
            f"{path}: {len(table)} frames are too few; expected {HELD_FRAMES + REST_FRAMES} at least"
        )
    if (np.diff(table[:, 0]) <= 0).any():
        raise BeamError(f"{path}: the times in t_s do not increase")
    tips = 1000.0 * table[:, 1:].reshape(-1, 3, 3)
    capture = Capture(path.stem, float(load[1]) if load else 0.0, table[:, 0], tips)
    if capture.release() < 0:
        raise BeamError(f"{path}: the tip never falls by {FALLEN_MM} mm, so nothing was released")
    return capture


def oscillation(time_s: np.ndarray, height_mm: np.ndarray) -> Oscillation:
    """First frequency and damping after a release at the start of the signal. Raises BeamError.

    A damped cosine about a slowly sinking mean (silicone creeps) is fitted in windows of two periods, one
    period apart, from a quarter of a period after the release; the error is the spread of the frequency over
    the windows.
    """
    period = _period(time_s, height_mm)
    fits = []
    for window in range(WINDOWS):
        start = time_s[0] + period * (0.25 + window)
        inside = (time_s >= start) & (time_s <= start + WINDOW_PERIODS * period)
        if time_s[-1] < start + (WINDOW_PERIODS - 0.25) * period:
            raise BeamError(
                f"the signal has fewer than {WINDOWS + WINDOW_PERIODS - 1:g} periods of {period:.3g} s"
            )
        fits.append(_fit(time_s[inside] - start, height_mm[inside], period))
    hz = [fit[0] for fit in fits]
    ratio = np.mean([fit[1] / np.hypot(fit[1], 2 * np.pi * fit[0]) for fit in fits])
    return Oscillation(float(np.mean(hz)), float(np.std(hz, ddof=1)), float(ratio))


def _period(time_s: np.ndarray, height_mm: np.ndarray) -> float:
    """Period [s] from the turning points."""
    prominence = LEAST_SWING * np.ptp(height_mm)
    ends = [find_peaks(sign * height_mm, prominence=prominence)[0] for sign in (1, -1)]
    periods = np.concatenate([np.diff(time_s[peaks]) for peaks in ends])
    if not len(periods):
        raise BeamError("the signal does not swing to and fro")
    return float(np.median(periods))


def _fit(time_s: np.ndarray, height_mm: np.ndarray, period: float) -> tuple[float, float]:
    """Frequency [Hz] and rate of decay [1/s] of a damped cosine about a straight line."""

    def model(
        t: np.ndarray, a: float, b: float, rate: float, hz: float, middle: float, slope: float
    ) -> np.ndarray:
        angle = 2 * np.pi * hz * t
        return np.exp(-rate * t) * (a * np.cos(angle) + b * np.sin(angle)) + middle + slope * t

    guess = (np.ptp(height_mm) / 2, 0.0, 0.1 / period, 1 / period, height_mm.mean(), 0.0)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OptimizeWarning)
            fitted = curve_fit(model, time_s, height_mm, guess, maxfev=5000)[0]
    except (RuntimeError, TypeError, ValueError):
        raise BeamError("no damped oscillation fits the signal") from None
    return abs(float(fitted[3])), float(fitted[2])
