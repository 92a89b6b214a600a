"""A scanline simulated by SIMUS (Garcia 2022, Comput Methods Programs Biomed 218, 106726), package
``pymust``: the reference.

SIMUS multiplies the fields of the transmit and of the receive aperture at each scatterer, frequency by
frequency; so the echo of many scatterers, one by one, takes two calls of its ``pfield``. It has the same
array as the probe: elements, pitch, bandwidth, one cycle, no apodization, the apertures of
``half_apertures_mm``.
"""

from typing import Any

import numpy as np

from errors import UserError
from ultrasound.beam import half_apertures_mm
from ultrasound.probe import Probe

SOUND_M_S = 1540.0
# Elements are narrower than their pitch by this part of it.
KERF = 0.1
THRESHOLD_DB = -80.0


class EchoStudyError(UserError):
    """The reference cannot be computed; the message is one line."""


def pymust() -> Any:
    """The package. Raises EchoStudyError."""
    try:
        import pymust
    except ImportError:
        raise EchoStudyError(
            "this study needs the package pymust: run python -m pip install -r requirements-dev.txt"
        ) from None
    return pymust


class SimusBeam:
    """One scanline of a probe, at a fractional index.

    ``has_elevation`` gives the elements their height and lens; without, space has two dimensions.
    """

    def __init__(self, probe: Probe, scanline: float, has_elevation: bool = True) -> None:
        self.probe, self.has_elevation = probe, has_elevation
        self.must = pymust()
        share = (scanline + 0.5) / probe.number_of_scanlines
        width = probe.array_width_mm
        self.elements = (np.arange(probe.number_of_elements) + 0.5) * probe.pitch_mm - width / 2
        self.is_phased = probe.transducer_geometry == "PHASED"
        self.place = 0.0 if self.is_phased else (share - 0.5) * width
        self.steering = 0.0
        if self.is_phased and probe.sector:
            _, start, stop = probe.sector
            self.steering = start + share * (stop - start)

    def points(
        self, along_mm: np.ndarray, depth_mm: np.ndarray | float, across_mm: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Points (n, 3) beside the scanline: lateral along an arc, depth and out of the image plane [mm]."""
        along, depth, across = np.broadcast_arrays(along_mm, depth_mm, across_mm)
        if self.probe.sector is None:
            return np.column_stack([self.place + along, across, depth])
        radius = self.probe.radius_mm
        angle = self.steering + (self.place / radius if radius else 0.0) + along / (radius + depth)
        return np.column_stack(
            [(radius + depth) * np.sin(angle), across, (radius + depth) * np.cos(angle) - radius]
        )

    def echoes(
        self, points: np.ndarray, depth_mm: float, attenuation_db_cm_mhz: float = 0.0, window_mm: float = 6.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depths [mm] around that of reception, and the complex echo of each point (n, 3) there, (n, depths).

        Points must be within the window around the depth, as later echoes overlap.
        """
        step = SOUND_M_S / (8 * window_mm * 1e-3)
        centre = self.probe.frequency_mhz * 1e6
        # Away from a rounding limit of SIMUS, so that both calls have the same frequencies.
        step = centre / (np.ceil(centre / step) - 0.5)
        transmit, receive = (float(half[0]) for half in half_apertures_mm(self.probe, np.array([depth_mm])))
        focus = self.probe.focus_mm
        frequency, sent = self._spectrum(points, transmit, focus, step, attenuation_db_cm_mhz)
        _, received = self._spectrum(points, receive, depth_mm, step, attenuation_db_cm_mhz)
        # Both contain the pulse; its spectrum is flat to a percent where anything is left.
        pulse = self.parameters.getPulseSpectrumFunction(None)(2 * np.pi * frequency)
        both = sent * received / np.where(np.abs(pulse) > 1e-3, pulse, np.inf)[:, None]
        depth = depth_mm + np.arange(-window_mm, window_mm, 0.02)
        time = (2 * depth - depth_mm - focus) * 1e-3 / SOUND_M_S
        echo = both.T @ np.exp(-2j * np.pi * np.outer(frequency, time))
        return depth, echo * np.exp(2j * np.pi * centre * time)

    def _spectrum(
        self, points: np.ndarray, half_mm: float, focus_mm: float, step_hz: float, attenuation: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies [Hz] and the field (frequencies, n) at points of an aperture with a focus."""
        probe = self.probe
        chosen = self.elements
        if not self.is_phased:
            chosen = chosen[np.abs(chosen - self.place) <= max(half_mm, 2 * probe.pitch_mm)]
        middle = (chosen[0] + chosen[-1]) / 2
        x, y, z, focus, elements, radius = self._in_aperture(points, chosen, middle, focus_mm)
        parameters = self.must.utils.Param()
        parameters.fc, parameters.bandwidth = probe.frequency_mhz * 1e6, probe.bandwidth_percent
        parameters.TXnow, parameters.c, parameters.attenuation = 1, SOUND_M_S, attenuation
        parameters.pitch, parameters.kerf = probe.pitch_mm * 1e-3, probe.pitch_mm * KERF * 1e-3
        parameters.Nelements = len(chosen)
        if radius:
            parameters.radius = radius * 1e-3
        if self.has_elevation:
            parameters.height = probe.element_height_mm * 1e-3
            parameters.focus = probe.elevation_focus_mm * 1e-3
        to_focus = np.linalg.norm(elements - focus, axis=1) * 1e-3 / SOUND_M_S
        delays = (to_focus.max() - to_focus)[None]
        far = np.linalg.norm(np.column_stack([x, z])[:, None] - elements, axis=2)
        longest = np.hypot(far, y[:, None]).max() * 1e-3 / SOUND_M_S
        options = self.must.utils.Options()
        options.dBThresh, options.WaitBar = THRESHOLD_DB, False
        options.FrequencyStep = step_hz * (longest + delays.max())
        columns = [1e-3 * axis[:, None] for axis in (x, y, z)]
        if not self.has_elevation:
            columns[1] = None  # type: ignore[call-overload]
        _, pressure, kept = self.must.pfield(*columns, delays, parameters, options=options)
        self.parameters = parameters
        frequency = np.linspace(0, 2 * parameters.fc, len(kept))
        field = np.zeros((len(kept), len(points)), complex)
        field[kept] = pressure[:, 0, :].T
        # Time counts from the focus.
        return frequency, field * np.exp(-2j * np.pi * frequency * to_focus.max())[:, None]

    def _in_aperture(
        self, points: np.ndarray, chosen: np.ndarray, middle: float, focus_mm: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Points x, y, z, focus (2,) and elements (e, 2) in SIMUS's axes of an aperture, its radius."""
        x, y, z = points.T.astype(float)
        radius = self.probe.radius_mm
        if not radius:
            elements = np.column_stack([chosen - middle, np.zeros(len(chosen))])
            direction = np.array([np.sin(self.steering), np.cos(self.steering)])
            return x - middle, y, z, focus_mm * direction + [self.place - middle, 0.0], elements, 0.0
        # SIMUS counts from the chord between the outermost elements.
        chord = radius * np.cos((chosen[-1] - chosen[0]) / 2 / radius)
        out, angle = np.hypot(x, z + radius), np.arctan2(x, z + radius) - middle / radius
        beam = (self.place - middle) / radius
        focus = (radius + focus_mm) * np.array([np.sin(beam), np.cos(beam)]) - [0.0, chord]
        on_arc = (chosen - middle) / radius
        elements = np.column_stack([radius * np.sin(on_arc), radius * np.cos(on_arc) - chord])
        return out * np.sin(angle), y, out * np.cos(angle) - chord, focus, elements, radius


def half_correlation(echoes: np.ndarray, step_mm: float) -> float:
    """Shift [mm] at which speckle intensity correlates by 1/2, of echoes (n, t) of points at even steps.

    The correlation is that of the echo with itself (Wagner 1983).
    """
    count = 1 << int(np.ceil(np.log2(2 * len(echoes))))
    together = np.fft.ifft((np.abs(np.fft.fft(echoes, count, axis=0)) ** 2).sum(axis=1))
    squared = np.abs(together[: len(echoes)]) ** 2
    below = int(np.argmax(squared < 0.5 * squared[0]))
    high, low = squared[below - 1] / squared[0], squared[below] / squared[0]
    return float(step_mm * (below - (0.5 - low) / (high - low)))


def full_width(place: np.ndarray, amplitude: np.ndarray) -> float:
    """Full width at half maximum of a profile with one peak."""
    above = np.flatnonzero(amplitude >= 0.5 * amplitude.max())
    half, first, last = 0.5 * amplitude.max(), above[0], above[-1]
    left = np.interp(half, amplitude[first - 1 : first + 1], place[first - 1 : first + 1])
    right = np.interp(-half, -amplitude[last : last + 2], place[last : last + 2])
    return float(right - left)
