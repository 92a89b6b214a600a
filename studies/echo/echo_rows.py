"""What ``study echo`` compares: the B-mode image of a virtual test object with SIMUS, quantity by
quantity.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from studies.echo.echo_phantom import IMPEDANCE, EchoPhantom
from studies.echo.simus_beam import SimusBeam, full_width, half_correlation
from studies.image_quality import RAYLEIGH_SNR, correlation_length, speckle_snr
from ultrasound.doppler import doppler_shift_khz
from ultrasound.interface import Surface
from ultrasound.probe import Probe, load_probe

# Bars: share of a width or length, decibels of a level, share of a Doppler shift.
WIDTH_BAR, LEVEL_BAR_DB, SHIFT_BAR = 0.2, 3.0, 0.05
DEPTHS_MM = {
    "drop-in": (9.0, 18.0, 30.0),
    "micro": (9.0, 18.0, 30.0),
    "linear": (10.0, 24.0, 50.0),
    "curvilinear": (30.0, 60.0, 110.0),
    "phased": (20.0, 65.0, 125.0),
}
TILTS_DEG = (5, 10, 20, 40)
CYST_RADIUS_MM = 2.0
# Scatterers in and around a cyst, of the reference.
CYST_POINTS = 30_000
# Speed of blood, and its angles to the direction of the array.
BLOOD_CM_S, FLOW_ANGLES_DEG = 20.0, (30, 45, 60, 75)
SMOOTH = Surface(roughness_mm=0.0, scattered=0.0, scattered_hard=0.0)
ROUGH = Surface(roughness_mm=0.03, slope=0.14, scattered=0.0, scattered_hard=0.0)
# Correlation length of a rough surface of that slope, and draws of it.
ROUGH_LENGTH_MM, DRAWS = float(np.sqrt(2) * 0.03 / 0.14), 100
SEED = 20181029
NEAR_FIELD = (
    "pymust counts the phase of the distance across the plane twice; this matters away from the "
    "elevation focus"
)
INVISIBLE = "no scanner shows it: below the speckle behind it"


@dataclass(frozen=True)
class Row:
    """One quantity: ours, that of the reference, its unit, and why they may differ by more than the bar."""

    name: str
    ours: float
    reference: float
    unit: str
    reason: str = ""

    def __post_init__(self) -> None:
        # From NumPy's numbers to those that JSON has.
        object.__setattr__(self, "ours", float(self.ours))
        object.__setattr__(self, "reference", float(self.reference))

    @property
    def is_within(self) -> bool:
        """Whether ours is within the bar of the reference."""
        if self.unit == "dB":
            return bool(abs(self.ours - self.reference) <= LEVEL_BAR_DB)
        bar = SHIFT_BAR if self.unit == "kHz" else WIDTH_BAR
        return bool(abs(self.ours / self.reference - 1) <= bar)


def rows() -> Iterator[Row]:
    """Compute all rows. Raises EchoStudyError where pymust is missing."""
    phantoms: dict[str, EchoPhantom] = {}
    parts = [
        (name, part)
        for name in DEPTHS_MM
        for part in (lateral_widths, elevation_lengths, *FURTHER_PARTS.get(name, ()))
    ]
    for name, part in tqdm(parts, desc="echo", unit="part"):
        phantom = phantoms.setdefault(name, EchoPhantom(load_probe(name)))
        yield from part(phantom, name)
    yield from steered_width(phantoms["phased"], "phased")


def _beam(probe: Probe, has_elevation: bool = True, scanline: float | None = None) -> SimusBeam:
    middle = (probe.number_of_scanlines - 1) / 2
    return SimusBeam(probe, middle if scanline is None else scanline, has_elevation)


def _simus_width(beam: SimusBeam, depth_mm: float, reach_mm: float) -> float:
    along = np.linspace(-reach_mm, reach_mm, 201)
    _, echoes = beam.echoes(beam.points(along, depth_mm), depth_mm)
    return full_width(along, np.abs(echoes).max(axis=1))


def lateral_widths(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """Full width at half maximum of a point on the middle scanline."""
    probe, middle = phantom.probe, phantom.probe.number_of_scanlines // 2
    for depth in DEPTHS_MM[name]:
        width = full_width(*phantom.point_response(middle, depth))
        reference = _simus_width(_beam(probe, scanline=middle), depth, 3 * width)
        yield Row(f"{name}, lateral width at {depth:g} mm", width, reference, "mm")


def edge_width(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """The same 1 mm from the end of the array."""
    probe, depth = phantom.probe, 18.0
    scanline = round(probe.number_of_scanlines * (1 - 1.0 / probe.array_width_mm) - 0.5)
    text = f"{name}, lateral width at {depth:g} mm, 1 mm from the edge"
    yield _inner_width(phantom, text, scanline, depth, 2.0)


def steered_width(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """The same on a steered scanline."""
    probe, depth, angle = phantom.probe, 65.0, 38.0
    share = (angle - probe.theta_start_deg) / (probe.theta_stop_deg - probe.theta_start_deg)
    scanline = round(share * probe.number_of_scanlines - 0.5)
    text = f"{name}, lateral width at {depth:g} mm, steered {angle:g} degrees"
    yield _inner_width(phantom, text, scanline, depth, 5.0)


def _inner_width(phantom: EchoPhantom, text: str, scanline: int, depth_mm: float, reach_mm: float) -> Row:
    """Twice the inner half of the width: beyond the array there are no scanlines."""
    place, amplitude = phantom.point_response(scanline, depth_mm)
    width = 2 * np.interp(-0.5, -(amplitude / amplitude[scanline])[scanline::-1], -place[scanline::-1])
    return Row(text, width, _simus_width(_beam(phantom.probe, scanline=scanline), depth_mm, reach_mm), "mm")


def elevation_curve(phantom: EchoPhantom, depth_mm: float, step_mm: np.ndarray) -> np.ndarray:
    """How speckle intensity at a depth correlates with that of planes some steps away."""
    phantom.fill(backscatter=0.1)
    part = np.abs(phantom.depth_mm - depth_mm) < 0.05 * phantom.probe.depth_mm
    curves = []
    for origin in np.random.default_rng(SEED).uniform(-200, 200, 10):
        frames = [phantom.amplitude(origin + step)[:, part] ** 2 for step in step_mm]
        frames = [frame - frame.mean() for frame in frames]
        curves.append([(frames[0] * frame).mean() for frame in frames] / (frames[0] ** 2).mean())
    return np.mean(curves, axis=0)


def elevation_lengths(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """Travel across the image plane to half of the speckle's correlation."""
    for depth in DEPTHS_MM[name][1:]:
        beam = _beam(phantom.probe)
        reach = 3 * max(phantom.probe.element_height_mm / 2, 0.05 * depth)
        across = np.linspace(-reach, reach, 241)
        _, echoes = beam.echoes(beam.points(np.zeros(241), depth, across), depth)
        reference = half_correlation(echoes, across[1] - across[0])
        step = np.linspace(0, 2.5 * reference, 16)
        curve = elevation_curve(phantom, depth, step)
        below = int(np.argmax(curve < 0.5))
        travel = np.interp(-0.5, -curve[: below + 1], step[: below + 1])
        text = f"{name}, elevational travel to half correlation at {depth:g} mm"
        yield Row(text, travel, reference, "mm", NEAR_FIELD)


def speckle_statistics(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """First- and second-order statistics of speckle in the image plane."""
    phantom.fill(backscatter=0.1)
    depth, part = 18.0, np.abs(phantom.depth_mm - 18.0) < 2.0
    images = [phantom.amplitude(at) for at in np.random.default_rng(SEED).uniform(-200, 200, 10)]
    amplitude = np.array([image[24:-24, part] for image in images])
    snr = float(np.mean([speckle_snr(image) for image in amplitude]))
    yield Row(f"{name}, speckle: mean over SD (Rayleigh)", snr, RAYLEIGH_SNR, "")
    beam, place = _beam(phantom.probe), np.linspace(-2, 2, 161)
    _, along = beam.echoes(beam.points(place, depth), depth)
    spacing = float(phantom.probe.line_spacing_mm(np.array([depth]))[0])
    _, axial = beam.echoes(beam.points(np.zeros(1), depth), depth)
    for way, axis, step, reference in (
        ("laterally", 1, spacing, half_correlation(along, place[1] - place[0])),
        ("axially", 2, phantom.probe.sample_mm, half_correlation(axial.T, 0.02)),
    ):
        length = step * correlation_length(amplitude, axis)
        yield Row(f"{name}, speckle to half correlation {way}", length, reference, "mm")


def interfaces(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """Echo of a flat interface at 18 mm, tilted, relative to the same without tilt."""
    beam, draw, depth = _beam(phantom.probe, False), np.random.default_rng(SEED), 18.0
    along = np.arange(-5, 5, 0.02)

    def ours(tilt_deg: float) -> float:
        slope = np.tan(np.radians(tilt_deg))
        width = 0.4 / np.cos(np.radians(tilt_deg))
        phantom.fill(lambda u, v: IMPEDANCE - 0.1 * np.clip((v - depth - slope * u) / width + 0.5, 0, 1))
        near = np.abs(phantom.depth_mm - depth) < 1.0
        echo = phantom.amplitude(probe=phantom.probe.model_copy(update={"noise_db": -200.0}))
        middle = len(echo) // 2
        return float(np.mean(echo[middle - 8 : middle + 8, near].max(axis=1) ** 2))

    def reference(tilt_deg: float, height_mm: float) -> float:
        tilt, peaks = np.radians(tilt_deg), []
        for _ in range(DRAWS if height_mm else 1):
            noise = np.convolve(
                draw.standard_normal(len(along)),
                np.exp(-2 * (np.arange(-60, 61) * 0.02 / ROUGH_LENGTH_MM) ** 2),
                "same",
            )
            height = height_mm * noise / noise.std()
            points = np.column_stack(
                [
                    along * np.cos(tilt) - height * np.sin(tilt),
                    0 * along,
                    depth + along * np.sin(tilt) + height * np.cos(tilt),
                ]
            )
            _, echoes = beam.echoes(points, depth, window_mm=8.0)
            peaks.append(np.abs(echoes.sum(axis=0)).max() ** 2)
        return float(np.mean(peaks))

    for text, surface, height in (("smooth", SMOOTH, 0.0), ("30 um rough", ROUGH, 0.03)):
        phantom.set_surface(surface)
        straight = ours(0), reference(0, height)
        for tilt in TILTS_DEG:
            level = 10 * np.log10(ours(tilt) / straight[0])
            simulated = 10 * np.log10(reference(tilt, height) / straight[1])
            reason = INVISIBLE if tilt >= 20 else ""
            yield Row(f"{name}, {text} interface tilted {tilt} degrees", level, simulated, "dB", reason)
    phantom.set_surface(Surface())


def cysts(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """Level in an anechoic cylinder across the image plane, relative to the tissue around it."""
    beam, draw, count = _beam(phantom.probe, False), np.random.default_rng(SEED), CYST_POINTS
    middle = phantom.probe.number_of_scanlines // 2
    for depth in DEPTHS_MM[name]:
        near = np.abs(phantom.depth_mm - depth) < 0.5
        places = np.random.default_rng(SEED).uniform(-200, 200, 12)

        def energy(backscatter: np.ndarray | float) -> np.ndarray:
            phantom.fill(backscatter=backscatter)
            return np.mean([phantom.amplitude(at)[middle - 3 : middle + 3, near] ** 2 for at in places])

        inside = energy(0.1 * (np.hypot(phantom.u, phantom.v - depth) > CYST_RADIUS_MM))
        level = 10 * np.log10(inside / energy(0.1))
        u, v = draw.uniform(-7, 7, count), depth + draw.uniform(-3, 3, count)
        at, echoes = beam.echoes(beam.points(u, v), depth, window_mm=4.0)
        simulated = (np.abs(echoes[:, np.abs(at - depth) < 0.5]) ** 2).mean(axis=1)
        beside = simulated[np.hypot(u, v - depth) > CYST_RADIUS_MM].sum()
        text = f"{name}, cyst of {2 * CYST_RADIUS_MM:g} mm at {depth:g} mm"
        yield Row(text, level, 10 * np.log10(beside / simulated.sum()), "dB")


def attenuation(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """Loss and length of the echo of an interface at 36 mm at 1 dB/cm/MHz, at several frequencies."""
    depth = 36.0
    for frequency in (5.0, 9.0, 13.0):
        probe = phantom.probe.model_copy(update={"frequency_mhz": frequency, "noise_db": -200.0})
        beam, levels, lengths = _beam(probe, False), [], []
        for loss in (0.0, 1.0):
            phantom.fill(lambda u, v: IMPEDANCE - 0.1 * np.clip((v - depth) / 0.4 + 0.5, 0, 1), loss)
            ours = phantom.amplitude(probe=probe)[probe.number_of_scanlines // 2]
            at, echo = beam.echoes(beam.points(np.zeros(1), depth), depth, loss)
            near = np.abs(phantom.depth_mm - depth) < 2.0
            levels.append((ours[near].max(), np.abs(echo[0]).max()))
            lengths.append((_length(phantom.depth_mm[near], ours[near]), full_width(at, np.abs(echo[0]))))
        lost = 20 * np.log10(np.divide(levels[1], levels[0]))
        text = f"{name}, {frequency:g} MHz, 36 mm at 1 dB/cm/MHz"
        yield Row(f"{text}: loss", lost[0], lost[1], "dB")
        for when, (ours, reference) in zip(("without", "with"), lengths, strict=True):
            yield Row(f"{text}: length of the pulse {when} it", ours, reference, "mm")


def doppler_shifts(phantom: EchoPhantom, name: str) -> Iterator[Row]:
    """Doppler shift of a vessel, against 2 f v cos(angle) / c."""
    probe, depth = phantom.probe, DEPTHS_MM[name][1]
    for angle in FLOW_ANGLES_DEG:
        velocity = float(phantom.vessel_velocity(BLOOD_CM_S, angle, depth).mean())
        along = BLOOD_CM_S * np.cos(np.radians(angle))
        ours, equation = (doppler_shift_khz(probe, speed) for speed in (velocity, along))
        text = f"{name}, Doppler shift of {BLOOD_CM_S:g} cm/s at {angle} degrees (by 2 f v cos / c)"
        yield Row(text, ours, equation, "kHz")


def _length(depth: np.ndarray, amplitude: np.ndarray) -> float:
    """Full width at half maximum of a Gaussian, whose samples are about as far apart."""
    top = amplitude > 0.01 * amplitude.max()
    curve = np.polyfit(depth[top], np.log(amplitude[top]), 2)[0]
    return float(np.sqrt(-4 * np.log(2) / curve))


# The elements of ``micro`` are less than a wavelength apart: its array has no grating lobes, which are not
# modelled, to fill its cysts.
FURTHER_PARTS = {
    "drop-in": (edge_width,),
    "micro": (speckle_statistics, edge_width, interfaces, cysts, attenuation, doppler_shifts),
}
