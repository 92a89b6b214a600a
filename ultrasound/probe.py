"""The array of a probe and the scanner's settings: probe files and scanline geometry.

A probe file is TOML with PLUS's names (TransducerGeometry, DepthMm, FrequencyMhz, ...), each with its unit.
Points on the image plane are (u, v) [mm]: u to the marked side, v down into the tissue, the origin at the
centre of the array face.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import ConfigDict, Field, ValidationError, model_validator
from pydantic.alias_generators import to_pascal

from errors import UserError, explained, meant
from settings import Control, Key, Section
from text_files import TextError, read_toml
from ultrasound.pulse import DB_OF_NEPER, PATH_STEP, SOUND_MM_US, AttenuatedPulse, attenuated_pulse

PROBES = Path(__file__).parent / "probes"
GAIN_RANGE_DB, TGC_RANGE_DB, TGC_SLIDERS = 60.0, 24.0, 8

Mode = Literal["both", "b-mode", "ct"]
# Realism of the B-mode image: reflection and attenuation; also speckle and point spread; also the slice
# thickness.
DetailLevel = Literal["reflection", "speckle", "elevation"]
DETAIL_LEVELS: tuple[DetailLevel, ...] = get_args(DetailLevel)

DopplerMode = Literal["off", "colour", "power"]

# Grey values: the exponent of the share of the dynamic range. On a scanner's screen most of the tissue is
# dark.
GreyMap = Literal["linear", "dark"]
GREY_EXPONENTS: dict[GreyMap, float] = {"linear": 1.0, "dark": 3.5}
# How much weaker harmonics are, where they have built up; and the depth at which they have half of that
# amplitude. An estimate.
HARMONIC_LOSS_DB, BUILD_UP_MM = 15.0, 12.0
# Range of the angles of spatial compounding.
COMPOUND_RANGE_DEG = 24.0
# Settings of Doppler alone.
DOPPLER_SETTINGS = ("velocity_scale_cm_s", "wall_filter_cm_s", "colour_gain_percent", "colour_steering_deg")
# Keys of earlier versions, and what now sets the same.
FORMER_KEYS = {"PulseCycles": "BandwidthPercent", "FocalZoneMm": "FNumber"}

Percent = Annotated[float, Field(ge=0, le=100)]
# Of a housing or array: those of transabdominal probes are up to 100 mm.
Length = Annotated[float, Field(gt=0, le=150)]
# TOML has lists where Python has tuples.
Lengths = Annotated[tuple[Length, Length, Length], Field(strict=False)]
FinLength = Annotated[float, Field(ge=0, le=150)]
FinLengths = Annotated[tuple[FinLength, FinLength, FinLength], Field(strict=False)]
Range = Annotated[tuple[float, float], Field(strict=False)]
Sliders = Annotated[tuple[Percent, ...], Field(strict=False, min_length=TGC_SLIDERS, max_length=TGC_SLIDERS)]


class ProbeError(UserError):
    """A probe file that cannot be used; the message is one line."""


class Probe(Section):
    """One probe with the scanner's settings, as its file has them in PLUS's spelling (``frequency_mhz`` is
    FrequencyMhz).

    ``housing_mm`` is the cuboid in contact: lateral x elevation x length. ``edge_radius_mm`` rounds its
    edges; sharp ones cut into tissue that they slide over. ``fin_mm``, lateral x elevation x height, is the
    fin on its back by which a grasper holds it, and ``cable_mm`` the diameter of the cable, which leaves the
    end without the mark: both are drawn, but touch nothing; 0 where there is none. ``f_number`` is that of
    the transmit and of the receive aperture. ``element_height_mm`` and the lens, focused at
    ``elevation_focus_mm``, shape the beam across the image plane; ``elevation_width_mm`` is the slice
    thickness that counts as scanned (coverage).
    ``bandwidth_percent`` is the -6 dB width of a round trip through the array, relative to the frequency.
    ``noise_db`` is the scanner's electronic noise before gain; 0 dB is the echo of a perfect reflector at the
    face. Its default gives the penetration of laparoscopic probes, 6 to 8 cm at 7.5 MHz, in wavelengths the
    same for others. ``ringing_db`` is the array's own vibration there, which dies down in the near field.
    ``harmonics`` receives at ``frequency_mhz`` what arises in tissue from half of it. ``compound_angles``
    images, steered by different angles, are averaged. ``steering_deg`` turns the scanlines from the face's
    normal towards +u, ``colour_steering_deg`` those of Doppler on a linear array. ``velocity_scale_cm_s`` is
    the greatest velocity that Doppler shows without aliasing, ``wall_filter_cm_s`` the least.
    ``depth_compensation_db_cm_mhz`` is the attenuation that the scanner's built-in TGC compensates, to which
    the sliders of ``time_gain_compensation`` [%] add.
    """

    model_config = ConfigDict(alias_generator=to_pascal, populate_by_name=True)

    transducer_name: str = Field(min_length=1, max_length=60)
    transducer_geometry: Literal["LINEAR", "CURVILINEAR", "PHASED"] = "LINEAR"
    housing_mm: Lengths = (40.0, 10.0, 20.0)
    edge_radius_mm: float = Field(0.0, ge=0, le=20)
    fin_mm: FinLengths = (0.0, 0.0, 0.0)
    cable_mm: float = Field(0.0, ge=0, le=20)
    transducer_width_mm: Length = 40.0
    radius_start_mm: float = Field(0.0, ge=0, le=300)
    theta_start_deg: float = Field(0.0, ge=-80, le=0)
    theta_stop_deg: float = Field(0.0, ge=0, le=80)
    number_of_scanlines: int = Field(192, ge=32, le=1024)
    number_of_samples_per_scanline: int = Field(640, ge=32, le=4096, multiple_of=16)
    frequency_range_mhz: Range = (2.0, 15.0)
    frequency_mhz: Annotated[float, Control("", "B-mode", limits="frequency_range_mhz")] = Field(
        7.5, ge=1, le=40
    )
    depth_mm: Annotated[float, Control("Depth", "Image", is_whole=True)] = Field(60.0, ge=5, le=300)
    focus_depth_percent: Annotated[Percent, Control("Focus", "B-mode", is_whole=True)] = 40.0
    number_of_elements: int = Field(128, ge=8, le=4096)
    f_number: float = Field(2.5, ge=0.5, le=20)
    element_height_mm: float = Field(5.0, gt=0, le=40)
    elevation_focus_mm: float = Field(25.0, gt=0, le=300)
    elevation_width_mm: float = Field(2.0, gt=0, le=20)
    bandwidth_percent: float = Field(75.0, ge=20, le=150)
    noise_db: float = Field(-102.0, ge=-200, le=0)
    ringing_db: float = Field(-36.0, ge=-200, le=0)
    gain_percent: Annotated[Percent, Control("Gain", "B-mode", is_whole=True)] = 68.0
    dyn_range_db: Annotated[float, Control("DR", "B-mode", is_whole=True)] = Field(60.0, ge=20, le=120)
    grey_map: Annotated[GreyMap, Control("Grey map", "B-mode")] = "dark"
    steering_deg: float = Field(0.0, ge=-30, le=30)
    compound_angles: Annotated[Literal[1, 3, 5], Control("Compounding", "B-mode")] = 1
    harmonics: Annotated[bool, Control("Harmonics", "B-mode")] = False
    velocity_scale_cm_s: Annotated[float, Control("", "Doppler", is_whole=True)] = Field(25.0, ge=2, le=200)
    wall_filter_cm_s: Annotated[float, Control("WF", "Doppler")] = Field(1.5, ge=0.2, le=20)
    colour_gain_percent: Annotated[Percent, Control("Gain", "Doppler", is_whole=True)] = 50.0
    colour_steering_deg: Annotated[float, Control("Steer", "Doppler", is_whole=True)] = Field(
        0.0, ge=-30, le=30
    )
    time_gain_compensation: Annotated[Sliders, Control("", "TGC", 0, 100, is_whole=True)] = (
        50.0,
    ) * TGC_SLIDERS
    depth_compensation_db_cm_mhz: float = Field(0.7, ge=0, le=5)

    @model_validator(mode="after")
    def _fits_its_housing(self) -> "Probe":
        lateral, elevation, length = self.housing_mm
        if self.edge_radius_mm > min(self.housing_mm) / 2:
            raise ValueError(
                f"EdgeRadiusMm = {self.edge_radius_mm:g}: expected at most half of the least of HousingMm, "
                f"{min(self.housing_mm) / 2:g}"
            )
        if any(self.fin_mm) and not all(self.fin_mm):
            raise ValueError("FinMm: expected three lengths above 0, or three of 0 for no fin")
        if self.fin_mm[0] > lateral or self.fin_mm[1] > elevation:
            raise ValueError(
                f"FinMm is {self.fin_mm[0]:g} x {self.fin_mm[1]:g} mm across, expected at most the "
                f"{lateral:g} x {elevation:g} mm of HousingMm"
            )
        if self.cable_mm > min(elevation, length):
            raise ValueError(
                f"CableMm = {self.cable_mm:g}: expected at most the smaller side of the housing's end, "
                f"{min(elevation, length):g}"
            )
        array = np.ptp(self.elements()[:, 0])
        if array > lateral:
            raise ValueError(f"the array is {array:.1f} mm wide, HousingMm {lateral:g}: it must fit in")
        return self

    @model_validator(mode="after")
    def _fits_together(self) -> "Probe":
        low, high = self.frequency_range_mhz
        if not 1 <= low <= self.frequency_mhz <= high <= 40:
            raise ValueError(
                f"FrequencyMhz = {self.frequency_mhz:g} is outside FrequencyRangeMhz = {low:g} to {high:g}"
            )
        if self.transducer_geometry != "LINEAR" and self.theta_stop_deg - self.theta_start_deg < 1:
            raise ValueError("a sector needs ThetaStartDeg < 0 < ThetaStopDeg, at least 1 degree apart")
        if self.transducer_geometry == "CURVILINEAR" and self.radius_start_mm <= 0:
            raise ValueError("a curvilinear array needs its radius: RadiusStartMm > 0")
        if self.transducer_geometry == "PHASED" and (self.steering_deg or self.compound_angles > 1):
            raise ValueError(
                f"SteeringDeg = {self.steering_deg:g}, CompoundAngles = {self.compound_angles}: the sector "
                "of a phased array is steered "
                "already; expected 0 and 1"
            )
        if self.transducer_geometry != "LINEAR" and self.colour_steering_deg:
            raise ValueError(
                f"ColourSteeringDeg = {self.colour_steering_deg:g}: only linear arrays steer Doppler; "
                "expected 0"
            )
        return self

    @property
    def fixed(self) -> frozenset[str]:
        """As ``Section.fixed``: the steering that its geometry excludes."""
        return {
            "LINEAR": frozenset[str](),
            "CURVILINEAR": frozenset({"colour_steering_deg"}),
            "PHASED": frozenset({"colour_steering_deg", "compound_angles"}),
        }[self.transducer_geometry]

    @property
    def wavelength_mm(self) -> float:
        """Wavelength in soft tissue."""
        return SOUND_MM_US / self.frequency_mhz

    @property
    def pulse(self) -> AttenuatedPulse:
        """The pulse, and how attenuation changes it."""
        return attenuated_pulse(self.frequency_mhz, self.bandwidth_percent)

    @property
    def axial_sd_mm(self) -> float:
        """Length of an interface's echo at the face."""
        return float(self.pulse.axial_sd_mm[0])

    @property
    def speckle_sd_mm(self) -> float:
        """Length of speckle at the face."""
        return float(self.pulse.speckle_sd_mm[0])

    @property
    def sample_mm(self) -> float:
        """Distance between samples."""
        return self.depth_mm / self.number_of_samples_per_scanline

    @property
    def radius_mm(self) -> float:
        """Radius of the array face; 0 where it is flat or all scanlines start at one point."""
        return self.radius_start_mm if self.transducer_geometry == "CURVILINEAR" else 0.0

    @property
    def sector(self) -> tuple[float, float, float] | None:
        """Radius of the face [mm], first and last angle [rad] of a sector; None for parallel scanlines."""
        if self.transducer_geometry == "LINEAR":
            return None
        start, stop = np.radians([self.theta_start_deg, self.theta_stop_deg])
        return self.radius_mm, float(start), float(stop)

    @property
    def focus_mm(self) -> float:
        """Depth of the focus."""
        return self.depth_mm * self.focus_depth_percent / 100

    @property
    def noise_before_gain_db(self) -> float:
        """Electronic noise relative to the echo, which is weaker with harmonics."""
        return self.noise_db + HARMONIC_LOSS_DB * self.harmonics

    @property
    def compound_angles_deg(self) -> list[float]:
        """Steering angles of the images that spatial compounding averages, the probe's own first."""
        half = COMPOUND_RANGE_DEG / 2 if self.compound_angles > 1 else 0.0
        return sorted(
            (self.steering_deg + np.linspace(-half, half, self.compound_angles)).tolist(),
            key=lambda angle: abs(angle - self.steering_deg),
        )

    @property
    def velocity_limit_cm_s(self) -> float:
        """The scale of velocity, or less where echoes of the whole depth must return before the next
        pulse.
        """
        pulse_mhz = SOUND_MM_US / (2 * self.depth_mm)
        most = SOUND_MM_US * pulse_mhz / (4 * self.frequency_mhz) * 1e5
        return min(self.velocity_scale_cm_s, most)

    @property
    def array_width_mm(self) -> float:
        """Length of the array along its face."""
        if self.transducer_geometry != "CURVILINEAR":
            return self.transducer_width_mm
        return self.radius_mm * float(np.radians(self.theta_stop_deg - self.theta_start_deg))

    @property
    def pitch_mm(self) -> float:
        """Distance of neighbouring elements."""
        return self.array_width_mm / self.number_of_elements

    @property
    def extent_mm(self) -> tuple[float, float, float]:
        """Width and depth of the image's bounding box, and the part of the depth behind the centre of the
        face.
        """
        if self.sector is None:
            return self.transducer_width_mm, self.depth_mm, 0.0
        radius, left, right = self.sector
        reach = radius + self.depth_mm
        half = reach * max(np.sin(right), np.sin(-left))
        above = radius * (1 - np.cos(max(right, -left)))
        return float(2 * half), float(self.depth_mm + above), float(above)

    def image_to_probe(self, rows: int, columns: int) -> np.ndarray:
        """The matrix (4, 4) from pixels (column, row, 0), counted from the first one's centre, to the probe's
        axes [mm].

        The axes are PLUS's: origin at the centre of the array face, x to the marked side, y into the tissue.
        """
        width, depth, above = self.extent_mm
        matrix = np.diag([width / columns, depth / rows, 1.0, 1.0])
        matrix[:2, 3] = width / columns / 2 - width / 2, depth / rows / 2 - above
        return matrix

    def scanlines(self) -> tuple[np.ndarray, np.ndarray]:
        """Start [mm] and unit direction of each scanline, each (scanlines, 2) on the image plane."""
        steering = np.radians(self.steering_deg)
        if self.sector is None:
            return self.elements(), np.tile(
                [np.sin(steering), np.cos(steering)], (self.number_of_scanlines, 1)
            )
        radius, start, stop = self.sector
        share = (np.arange(self.number_of_scanlines) + 0.5) / self.number_of_scanlines
        angle = start + share * (stop - start)
        normal, direction = (
            np.column_stack([np.sin(radians), np.cos(radians)]) for radians in (angle, angle + steering)
        )
        return radius * (normal - [0.0, 1.0]), direction

    def elements(self) -> np.ndarray:
        """The elements on the face (scanlines, 2) [mm]: the starts of the scanlines, or across a phased
        array.
        """
        if self.transducer_geometry == "CURVILINEAR":
            return self.scanlines()[0]
        share = (np.arange(self.number_of_scanlines) + 0.5) / self.number_of_scanlines - 0.5
        return np.column_stack([share * self.transducer_width_mm, np.zeros_like(share)])

    def face_normals(self) -> np.ndarray:
        """The unit normals of the face at ``elements``, into the tissue, (scanlines, 2)."""
        straight = np.tile([0.0, 1.0], (self.number_of_scanlines, 1))
        return straight + self.elements() / self.radius_mm if self.radius_mm > 0 else straight

    def line_spacing_mm(self, depth_mm: np.ndarray) -> np.ndarray:
        """The distance of neighbouring scanlines at depths [mm]."""
        if self.transducer_geometry == "LINEAR":
            return np.full_like(depth_mm, self.transducer_width_mm / self.number_of_scanlines)
        step = np.radians(self.theta_stop_deg - self.theta_start_deg) / self.number_of_scanlines
        return (self.radius_mm + depth_mm) * step

    def beam_coordinates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scanline (fractional index) and depth along it [mm] of points on the plane [mm]."""
        steering = np.radians(self.steering_deg)
        if self.sector is None:
            at_face = u - v * np.tan(steering)
            line = (at_face / self.transducer_width_mm + 0.5) * self.number_of_scanlines - 0.5
            return line, v / np.cos(steering)
        radius, start, stop = self.sector
        away = np.hypot(u, v + radius)
        # The triangle of the array's centre, the start of the scanline and the point.
        depth = np.sqrt(np.maximum(away**2 - (radius * np.sin(steering)) ** 2, 0)) - radius * np.cos(steering)
        turn = np.arcsin(np.clip(depth * np.sin(steering) / np.maximum(away, 1e-9), -1, 1))
        share = (np.arctan2(u, v + radius) - turn - start) / (stop - start)
        return share * self.number_of_scanlines - 0.5, depth

    def gain_db(self) -> np.ndarray:
        """Gain and TGC at each sample of a scanline [dB], (samples,)."""
        depth = (np.arange(self.number_of_samples_per_scanline) + 0.5) * self.sample_mm
        path = 2 * self.depth_compensation_db_cm_mhz * depth / 10 / DB_OF_NEPER
        loss = self.pulse.speckle_db
        own = -np.interp(path, PATH_STEP * np.arange(len(loss)), loss)
        places = (np.arange(TGC_SLIDERS) + 0.5) * self.depth_mm / TGC_SLIDERS
        sliders = np.interp(depth, places, self.time_gain_compensation)
        return own + (self.gain_percent - 50) / 100 * GAIN_RANGE_DB + (sliders - 50) / 100 * TGC_RANGE_DB


class ScannerSettings(Section):
    """Settings of the scanner that are no part of a probe's file."""

    persistence_percent: Annotated[int, Control("Pers.", "B-mode")] = Field(0, ge=0, le=95)
    doppler: Annotated[DopplerMode, Key("Tab", "Image", "Doppler: colour, power, off")] = "off"
    clamped: Annotated[bool, Control("Hilum clamped", "Doppler")] = False


def load_probe(name: str) -> Probe:
    """A built-in probe by name, else the probe of a file. Raises ProbeError."""
    built_in = PROBES / f"{name}.toml"
    path = built_in if built_in.is_file() else Path(name)
    try:
        return probe_of_values(read_toml(path))
    except (FileNotFoundError, NotADirectoryError):
        known = ", ".join(sorted(file.stem for file in PROBES.glob("*.toml")))
        raise ProbeError(f"transducer.probe: {name!r} is no file, and known by name are {known}") from None
    except TextError as error:
        raise ProbeError(
            f"{path}: cannot be read as a probe file ({error}); expected TOML in UTF-8"
        ) from None
    except ProbeError as error:
        raise ProbeError(f"{path}: {error}") from None


def probe_of_values(values: Mapping[str, object]) -> Probe:
    """The probe of a file's values. Raises ProbeError, which names the key."""
    for key in FORMER_KEYS.keys() & values.keys():
        raise ProbeError(f"{key} no longer exists; delete it ({FORMER_KEYS[key]} sets the same)")
    return _validated(values)


def changed_probe(probe: Probe, **changes: object) -> Probe:
    """A probe with some fields changed. Raises ProbeError where they do not fit together."""
    return _validated(probe.model_dump() | changes)


def _validated(values: Mapping[str, object]) -> Probe:
    try:
        return Probe.model_validate(values)
    except ValidationError as error:
        known = [to_pascal(name) for name in Probe.model_fields]
        raise ProbeError(explained(error, lambda where: f"unknown key; {meant(where[-1], known)}")) from None
