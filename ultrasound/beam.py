"""The ultrasound beam of a probe: its profiles across the scanlines and across the image plane. NumPy.

Profiles are sums of spherical waves from points of the transmit and of the receive aperture (Huygens), over
frequencies of the pulse. The transmit aperture is focused at the focus, the receive aperture at every depth
(dynamic focusing). Neither has apodization. Both end where the array ends.
"""

import numpy as np

from ultrasound.probe import Probe
from ultrasound.pulse import FWHM_OF_SD, SOUND_MM_US, pulse_spectrum

# Points of an aperture, and frequencies of the pulse that are summed.
APERTURE_POINTS, SUMMED_FREQUENCIES = 48, 3
# Depths at which profiles are computed; between them they are interpolated.
PROFILE_DEPTHS = 12
# Least half width of an aperture, in wavelengths: one element.
MIN_APERTURE = 0.5


def summed_frequencies(probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """A few frequencies [MHz] that stand for the pulse, and their shares of its energy."""
    frequency, amplitude = pulse_spectrum(probe.frequency_mhz, probe.bandwidth_percent)
    below = np.cumsum(amplitude**2) / (amplitude**2).sum()
    nodes, weights = np.polynomial.legendre.leggauss(SUMMED_FREQUENCIES)
    return np.interp(nodes / 2 + 0.5, below, frequency), weights / 2


def profile_depths(probe: Probe) -> np.ndarray:
    """Depths [mm] at which profiles are computed, denser near the face."""
    return probe.depth_mm * np.linspace(0.08, 1.0, PROFILE_DEPTHS) ** 1.5


def half_apertures_mm(probe: Probe, depth_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half widths of the transmit and of the receive aperture at depths [mm], before the array's ends limit
    them.
    """
    least = MIN_APERTURE * probe.wavelength_mm
    if probe.transducer_geometry == "PHASED":
        whole = np.full(np.shape(depth_mm), probe.transducer_width_mm / 2)
        return whole, whole
    transmit = np.full(np.shape(depth_mm), probe.focus_mm / (2 * probe.f_number))
    return np.maximum(transmit, least), np.maximum(np.asarray(depth_mm) / (2 * probe.f_number), least)


def lateral_profiles(probe: Probe, scanline: float, depth_mm: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """How a scanline sees scatterers on its neighbours: amplitude (depths, lags), 1 on the scanline itself.

    ``scanline`` is its index; ``lag`` are distances in scanlines, at the same depth.
    """
    at, to = _on_scanlines(probe, scanline, depth_mm), _on_scanlines(probe, scanline + lag, depth_mm)
    axis = _on_scanlines(probe, scanline, np.array([probe.focus_mm]))
    energy = np.zeros((len(depth_mm), len(lag)))
    on_axis = np.zeros(len(depth_mm))
    for frequency, share in zip(*summed_frequencies(probe), strict=True):
        fields = []
        for half, focus in zip(half_apertures_mm(probe, depth_mm), (axis, at), strict=True):
            elements = _aperture(probe, scanline, half)
            fields.append([_field(*elements, focus, place, frequency, probe.pitch_mm) for place in (to, at)])
        if probe.harmonics:
            # Sound of twice the frequency arises as the square of the transmitted field.
            elements = _aperture(probe, scanline, half_apertures_mm(probe, depth_mm)[0])
            sent = [_field(*elements, axis, place, frequency / 2, probe.pitch_mm) for place in (to, at)]
            fields[0] = [field**2 for field in sent]
        energy += share * np.abs(fields[0][0] * fields[1][0]) ** 2
        on_axis += share * np.abs(fields[0][1] * fields[1][1])[:, 0] ** 2
    return np.sqrt(energy / on_axis[:, None])


def elevation_profiles(probe: Probe, depth_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The slice thickness and the correlation of speckle across the image plane at depths, each as an SD
    [mm].

    The thickness is that of the two-way beam (full width at half maximum). Speckle at a distance d from the
    plane correlates as exp(-d^2 / (2 SD^2)) in intensity; in a beam out of focus it is finer than the beam is
    wide (Wagner 1983).
    """
    height, focus = probe.element_height_mm, probe.elevation_focus_mm
    half = np.full(len(depth_mm), height / 2)
    reach = 1.5 * height * np.maximum(1.0, depth_mm / focus) + 2 * probe.wavelength_mm * depth_mm / height
    offset = reach[:, None] * np.linspace(-1, 1, 129)
    place = np.stack([offset, np.broadcast_to(depth_mm[:, None], offset.shape)], axis=-1)
    points = np.stack([half[:, None] * _nodes(), np.zeros((len(half), APERTURE_POINTS))], axis=-1)
    normals = np.broadcast_to([0.0, 1.0], points.shape)
    lens = np.broadcast_to([0.0, focus], (len(depth_mm), 1, 2))
    energy, correlation = np.zeros(offset.shape), np.zeros((len(depth_mm), 256))
    for frequency, share in zip(*summed_frequencies(probe), strict=True):
        received = _field(points, normals, lens, place, frequency)
        sent = _field(points, normals, lens, place, frequency / 2) ** 2 if probe.harmonics else received
        echo = sent * received
        energy += share * np.abs(echo) ** 2
        spectrum = np.abs(np.fft.fft(echo, 256)) ** 2
        correlation = correlation + share * np.fft.ifft(spectrum).real
    step = offset[:, 1] - offset[:, 0]
    thickness = np.array([_width(x, e) for x, e in zip(offset, np.sqrt(energy), strict=True)])
    lag = np.array([_first_below(c / c[0], np.sqrt(0.5)) for c in correlation]) * step
    return thickness / FWHM_OF_SD, lag / np.sqrt(2 * np.log(2))


def _nodes() -> np.ndarray:
    return (np.arange(APERTURE_POINTS) + 0.5) / APERTURE_POINTS * 2 - 1


def _on_scanlines(probe: Probe, index: float | np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """Points (depths, indices, 2) [mm] of the image plane on scanlines, of which the indices are
    fractional.
    """
    share, steering = (np.atleast_1d(index) + 0.5) / probe.number_of_scanlines, np.radians(probe.steering_deg)
    depth = np.asarray(depth_mm, float)[:, None]
    if probe.sector is None:
        u = (share - 0.5) * probe.transducer_width_mm + depth * np.sin(steering)
        return np.stack(np.broadcast_arrays(u, depth * np.cos(steering)), axis=-1)
    radius, start, stop = probe.sector
    angle = start + share * (stop - start)
    u, v = (radius * turn(angle) + depth * turn(angle + steering) for turn in (np.sin, np.cos))
    return np.stack([u, v - radius], axis=-1)


def _aperture(probe: Probe, scanline: float, half_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of an aperture around a scanline [mm] and their normals, both (depths, APERTURE_POINTS, 2).

    It is cut off at the array's ends.
    """
    centre = (
        0.0 if probe.transducer_geometry == "PHASED" else (scanline + 0.5) / probe.number_of_scanlines - 0.5
    )
    width = probe.array_width_mm
    low = np.maximum(centre * width - half_mm, -width / 2)
    high = np.minimum(centre * width + half_mm, width / 2)
    along = (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * _nodes()
    if probe.transducer_geometry != "CURVILINEAR":
        flat = np.zeros_like(along)
        return np.stack([along, flat], axis=-1), np.stack([flat, flat + 1], axis=-1)
    radius, start, stop = probe.sector or (1.0, 0.0, 0.0)
    angle = (start + stop) / 2 + along / radius
    normals = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return radius * (normals - [0.0, 1.0]), normals


def _field(
    points: np.ndarray,
    normals: np.ndarray,
    focus: np.ndarray,
    place: np.ndarray,
    frequency_mhz: float,
    pitch_mm: float = 0.0,
) -> np.ndarray:
    """The field (depths, places) of an aperture (depths, APERTURE_POINTS, 2) focused at (.., 1, 2), at
    (depths, places, 2).

    Elements as wide as the pitch, in a soft baffle, radiate less to the side (Selfridge 1980).
    """
    wave = np.float32(2 * np.pi * frequency_mhz / SOUND_MM_US)
    to_focus = np.hypot(*np.moveaxis(points - focus, -1, 0)).astype(np.float32)
    # Axis by axis and in single precision, as a slider waits for this: 40 mm are right to 0.001 of a radian.
    x, z = ((place[:, :, None, i] - points[:, None, :, i]).astype(np.float32) for i in range(2))
    distance = np.sqrt(x * x + z * z)
    normal_x, normal_z = np.moveaxis(normals[:, None].astype(np.float32), -1, 0)
    cosine = np.clip((x * normal_x + z * normal_z) / np.maximum(distance, np.float32(1e-6)), 0, 1)
    weight = cosine / np.sqrt(distance + np.float32(0.1))
    if pitch_mm:
        weight *= np.sinc(wave * np.float32(pitch_mm / (2 * np.pi)) * np.sqrt(1 - cosine * cosine))
    phase = wave * (distance - to_focus[:, None])
    count = phase.shape[-1]
    return ((weight * np.cos(phase)).sum(axis=-1) + 1j * (weight * np.sin(phase)).sum(axis=-1)) / count


def _first_below(values: np.ndarray, limit: float) -> float:
    """The fractional index at which falling values first are below a limit; the last one if they never
    are.
    """
    below = int(np.argmax(values < limit))
    if below == 0:
        return len(values) / 2
    return float(below - (limit - values[below]) / (values[below - 1] - values[below]))


def _width(offset: np.ndarray, amplitude: np.ndarray) -> float:
    """The full width at half maximum around the middle."""
    middle, step = len(offset) // 2, offset[1] - offset[0]
    half = 0.5 * amplitude[middle]
    return float(step * (_first_below(amplitude[middle:], half) + _first_below(amplitude[middle::-1], half)))
