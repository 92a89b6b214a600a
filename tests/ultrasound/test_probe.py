"""Probe files, the geometry of scanlines, what of the array touches, and from lines to the picture."""

import json
import re

import numpy as np
import pytest
import trimesh
from pulse_oracle import loss_db
from pydantic.alias_generators import to_pascal
from scipy import ndimage
from test_bmode import (
    GEOMETRIES,
    LINES,
    PIXELS,
    SILENT_DB,
    TISSUE,
    USUAL,
    Tank,
    flat_tank,
    probe_of,
)

from ultrasound.probe import GREY_EXPONENTS, PROBES, Probe, ProbeError, load_probe
from ultrasound.probe_manipulator import advanced, pose_at
from ultrasound.sampled_volume import distance_volume

KNOWN = sorted(path.stem for path in PROBES.glob("*.toml"))


@pytest.mark.parametrize("name", KNOWN)
def test_the_programs_own_probes_load(name):
    probe = load_probe(name)
    low, high = probe.frequency_range_mhz
    assert low <= probe.frequency_mhz <= high and name.split("-")[0].upper() in probe.transducer_name.upper()
    # An aperture that fits, and lines no farther apart at the focus than the beam is wide there.
    assert probe.line_spacing_mm(np.array([probe.focus_mm]))[0] < probe.wavelength_mm * probe.f_number


def test_a_probe_of_each_geometry_comes_along():
    assert {"drop-in", "micro"} <= set(KNOWN)
    assert {load_probe(name).transducer_geometry for name in KNOWN} == set(GEOMETRIES)


def test_a_probe_goes_through_plus_names_and_back(tmp_path):
    probe = probe_of("CURVILINEAR", time_gain_compensation=(40.0, 45.0, 50.0, 55.0, 60.0, 65.0, 70.0, 75.0))
    named = probe.model_dump(by_alias=True)
    assert {"TransducerGeometry", "DepthMm", "FrequencyMhz", "DepthCompensationDbCmMhz", "FNumber"} <= set(
        named
    )
    assert list(named) == [to_pascal(name) for name in Probe.model_fields]
    texts = {key: list(value) if isinstance(value, tuple) else value for key, value in named.items()}
    written = "\n".join(f"{key} = {json.dumps(value)}" for key, value in texts.items())
    (tmp_path / "mine.toml").write_text(written)
    assert load_probe(str(tmp_path / "mine.toml")) == probe


GOOD = 'TransducerName = "x"\n'
WRONG = {
    "an unknown key": (
        GOOD + "FrequencyMHz = 7.5\n",
        "FrequencyMHz: unknown key; did you mean FrequencyMhz",
    ),
    "a key of an earlier version": (
        GOOD + "PulseCycles = 2.0\n",
        r"PulseCycles no longer exists; delete it \(BandwidthPercent sets the same\)",
    ),
    "a wrong type": (GOOD + 'DepthMm = "deep"\n', "DepthMm = 'deep': input should be a valid number"),
    "a number in quotes": (GOOD + 'DepthMm = "60"\n', "DepthMm = '60': input should be a valid number"),
    "a missing name": ("DepthMm = 60.0\n", "TransducerName: missing"),
    "an array wider than its housing": (
        GOOD + "TransducerWidthMm = 50\n",
        "the array is 49.7 mm wide, HousingMm 40: it must fit in",
    ),
    "a fin without a height": (
        GOOD + "FinMm = [18, 2, 0]\n",
        "FinMm: expected three lengths above 0, or three of 0 for no fin",
    ),
    "a fin wider than its housing": (
        GOOD + "FinMm = [18, 12, 3]\n",
        "FinMm is 18 x 12 mm across, expected at most the 40 x 10 mm of HousingMm",
    ),
    "a cable thicker than its housing": (
        GOOD + "CableMm = 11\n",
        "CableMm = 11: expected at most the smaller side of the housing's end, 10",
    ),
    "an unknown geometry": (
        GOOD + 'TransducerGeometry = "CONVEX"\n',
        "TransducerGeometry = 'CONVEX': input should be",
    ),
    "no TOML": ("TransducerName = \n", "cannot be read as a probe file"),
    "a frequency out of range": (
        GOOD + "FrequencyMhz = 20.0\n",
        "FrequencyMhz = 20 is outside FrequencyRangeMhz = 2 to 15",
    ),
    "a slider too few": (
        GOOD + f"TimeGainCompensation = {[50.0] * 7}\n",
        "TimeGainCompensation = .*: tuple should have at least 8 items",
    ),
    "a slider beyond": (
        GOOD + f"TimeGainCompensation = {[50.0] * 7 + [101.0]}\n",
        "TimeGainCompensation.7 = 101.0",
    ),
    "no depth": (GOOD + "DepthMm = nan\n", "DepthMm = nan"),
    "a flat housing": (
        GOOD + "HousingMm = [40.0, 0.0, 20.0]\n",
        "HousingMm.1 = 0.0: input should be greater than 0",
    ),
    "a housing that passes through no skin": (
        GOOD + "HousingMm = [40.0, 10.0, 151.0]\n",
        "HousingMm.2 = 151.0: input should be less than or equal to 150",
    ),
    "a face as wide as a patient": (
        GOOD + "HousingMm = [150.0, 10.0, 20.0]\nTransducerWidthMm = 160\n",
        "TransducerWidthMm = 160: input should be less than or equal to 150",
    ),
    "a sector of no angle": (GOOD + 'TransducerGeometry = "PHASED"\n', "ThetaStartDeg < 0 < ThetaStopDeg"),
    "a curve of no radius": (
        GOOD + 'TransducerGeometry = "CURVILINEAR"\nThetaStartDeg = -30.0\nThetaStopDeg = 30.0\n',
        "RadiusStartMm > 0",
    ),
}


@pytest.mark.parametrize("wrong", list(WRONG))
def test_a_wrong_probe_file_is_refused_with_a_line_that_names_the_key(tmp_path, wrong):
    text, line = WRONG[wrong]
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(ProbeError, match=line) as refused:
        load_probe(str(tmp_path / "mine.toml"))
    message = str(refused.value)
    assert "\n" not in message and message.startswith(str(tmp_path / "mine.toml"))


def test_a_missing_probe_file_is_reported_with_the_known_names():
    with pytest.raises(ProbeError, match="'none' is no file, and known by name are " + ", ".join(KNOWN)):
        load_probe("none")


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ProbeError, match=re.escape("cannot be read as a probe file")):
        load_probe(str(tmp_path / "mine.toml"))


@pytest.mark.parametrize("geometry", list(GEOMETRIES))
def test_lines_leave_the_face_at_the_middles_of_equal_shares(geometry):
    probe = probe_of(geometry)
    share = np.array([(i + 0.5) / LINES - 0.5 for i in range(LINES)])
    start, direction = probe.scanlines()
    if geometry == "LINEAR":
        wanted, angle = np.column_stack([40.0 * share, 0 * share]), 0 * share
    else:
        middle, whole = np.radians({"CURVILINEAR": (-2.5, 45.0), "PHASED": (0.0, 80.0)}[geometry])
        angle = middle + whole * share
        # On a circle about (0, -radius), whose lowest point is the origin.
        wanted = probe.radius_mm * np.column_stack([np.sin(angle), np.cos(angle) - 1])
    assert start == pytest.approx(wanted, abs=1e-12)
    assert direction == pytest.approx(np.column_stack([np.sin(angle), np.cos(angle)]), abs=1e-12)
    # A phased array's lines leave from one point, but all of its face must touch.
    elements = np.column_stack([20.0 * share, 0 * share]) if geometry == "PHASED" else wanted
    assert probe.elements() == pytest.approx(elements, abs=1e-12)


@pytest.mark.parametrize(
    "geometry, steering", [*((name, 0.0) for name in GEOMETRIES), ("LINEAR", -20.0), ("CURVILINEAR", 12.0)]
)
def test_beam_coordinates_invert_the_scanlines(geometry, steering):
    probe = probe_of(geometry, steering_deg=steering)
    start, direction = probe.scanlines()
    turned = np.arctan2(*direction.T) - np.arctan2(*probe_of(geometry).scanlines()[1].T)
    assert np.degrees(turned) == pytest.approx(steering, abs=1e-6)
    lines, along = np.meshgrid(np.arange(LINES), [1.0, 17.3, 40.0, 79.9], indexing="ij")
    place = start[lines] + along[..., None] * direction[lines]
    line, depth = probe.beam_coordinates(place[..., 0], place[..., 1])
    assert line == pytest.approx(lines, abs=1e-9) and depth == pytest.approx(along, abs=1e-9)
    if geometry == "CURVILINEAR" and steering:
        return  # Their distance is that along the face.
    # Neighbouring lines are as far apart as is said: the chord is 1 - step^2 / 24 of the arc.
    apart = np.linalg.norm(np.diff(place, axis=0), axis=-1)
    assert apart == pytest.approx(np.tile(probe.line_spacing_mm(along[0]), (LINES - 1, 1)), rel=1e-5)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_face_normals_are_perpendicular_to_the_face(geometry):
    probe = probe_of(geometry)
    elements, normals = probe.elements(), probe.face_normals()
    along = np.gradient(elements, axis=0)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(LINES)) and (normals[:, 1] > 0).all()
    assert np.einsum("ij,ij->i", along, normals)[1:-1] == pytest.approx(np.zeros(LINES - 2), abs=1e-9)


def test_angles_of_compounding_are_around_that_of_the_probe_which_is_the_first():
    assert probe_of(compound_angles=3).compound_angles_deg == [0.0, -12.0, 12.0]
    assert probe_of(compound_angles=3, steering_deg=10.0).compound_angles_deg == [10.0, -2.0, 22.0]
    assert probe_of(steering_deg=10.0).compound_angles_deg == [10.0]


@pytest.mark.parametrize(
    "geometry, settings, meant",
    [
        ("PHASED", {"steering_deg": 5.0}, "steered already"),
        ("PHASED", {"compound_angles": 3}, "steered already"),
        ("CURVILINEAR", {"colour_steering_deg": 10.0}, "only linear arrays"),
    ],
)
def test_what_an_array_cannot_steer_is_refused(geometry, settings, meant):
    with pytest.raises(ValueError, match=meant):
        probe_of(geometry, **settings)


def test_a_pictures_pixels_are_where_its_matrix_takes_them():
    probe = load_probe("curvilinear")
    width, depth, above = probe.extent_mm
    matrix = probe.image_to_probe(rows=50, columns=80)
    corners = np.array([[-0.5, -0.5, 0, 1], [79.5, -0.5, 0, 1], [-0.5, 49.5, 0, 1]])
    places = [[-width / 2, -above, 0, 1], [width / 2, -above, 0, 1], [-width / 2, depth - above, 0, 1]]
    assert corners @ matrix.T == pytest.approx(np.array(places))


def test_gain_is_the_sum_of_knob_course_and_sliders():
    sliders = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0)
    probe = probe_of(
        gain_percent=65.0, depth_compensation_db_cm_mhz=0.7, time_gain_compensation=sliders, depth_mm=64.0
    )
    gain = probe.gain_db()
    # 65 % is 15 % of 60 dB up. At 4, 12, 20 .. 60 mm sliders hold, 24 dB over their range, in between they
    # are mixed, and before the first and behind the last they stay; 0.7 dB/cm/MHz are 0.14 dB/mm/MHz, there
    # and back.
    for depth, slider in (
        (2.05, 10.0),
        (12.05, 20.0 + 10 * 0.05 / 8),
        (36.05, 50.0 + 10 * 0.05 / 8),
        (63.95, 80.0),
    ):
        wanted = 9.0 + loss_db(0.14 * depth, 7.5)[0] + (slider - 50) / 100 * 24
        assert gain[round(depth / 0.1 - 0.5)] == pytest.approx(wanted, abs=0.02)


@pytest.fixture(scope="module")
def tank(one_device) -> Tank:
    return flat_tank(0.5)


@pytest.fixture(scope="module")
def gated(one_device) -> Tank:
    """Sound enters within a millimetre of the organ, which is all below y = 0."""
    organ = trimesh.creation.box([70.0, 60.0, 30.0])
    organ.apply_translation([0.0, 30.0, 0.0])
    tank = flat_tank(0.5, organ=distance_volume(organ, 1.0), contact="organ")
    tank.fill(backscatter=0.1)
    return tank


def test_a_lifted_probe_is_dark_and_sees_again_when_pressed(gated):
    for height, dark in ((-2.0, False), (1.1, True), (0.9, False), (10.0, True)):
        decibel = gated.look(probe_of(), at=(0.0, -height, 0.0))
        assert decibel.max() < SILENT_DB if dark else np.abs(decibel + 20.0).max() < 1e-3
        assert (gated.picture == 0).all() if dark else gated.picture.min() > 0


def test_of_a_tilted_probe_only_the_aperture_in_contact_receives(gated):
    probe, tilted = probe_of(), (np.sin(0.1), np.cos(0.1), 0.0)
    # Its middle at the gap's end, and the side lower that looks away.
    decibel = gated.look(probe, "reflection", (0.0, -1.0, 0.0), tilted)
    u = probe.scanlines()[0][:, 0]
    # To 1 mm, the first tissue sample, rays of the aperture are less than 0.2 mm aside.
    assert np.abs(decibel[u < -0.25, :8] + 20.0).max() < 1e-3 and decibel[u > 0.25, :8].max() < SILENT_DB
    # Deep down the lines on either side of the end of contact transmit, and receive, with half of the
    # aperture: 3 or 4 of 7 rays.
    at_end = decibel[LINES // 2 - 1 : LINES // 2 + 1, 600]
    assert at_end == pytest.approx(np.full(2, -20.0 + 40 * np.log10(0.5)), abs=40 * np.log10(3.5 / 3) + 0.05)
    pressed = advanced(pose_at((0.0, -1.0, 0.0), tilted, (1.0, 0.0, 0.0), 20.0), 2.5)
    face = pressed[:3, 3] - 10.0 * pressed[:3, 2]
    assert np.abs(gated.look(probe, "reflection", face, tilted) + 20.0).max() < 1e-3


def test_gas_lets_no_sound_in(tank):
    tank.fill(lambda x, y, z: np.where(x < 0.0, TISSUE, 4e-4), 0.0, 0.1)
    decibel, u = tank.look(probe_of()), probe_of().scanlines()[0][:, 0]
    # A voxel is half tissue and half gas.
    assert np.abs(decibel[u < -0.5, :8] + 20.0).max() < 1e-3
    assert decibel[u > 0.5, :8].max() < SILENT_DB


@pytest.mark.parametrize("height, dark", [(0.2, False), (0.8, True)])
def test_sound_crosses_half_of_the_gap_to_tissue(tank, height, dark):
    tank.fill(lambda x, y, z: np.where(y < 0.0, 4e-4, TISSUE), 0.0, 0.1)
    # Of a gap of 1 mm; tissue begins within the voxel of 0.5 mm about y = 0.
    decibel = tank.look(probe_of(), at=(0.0, -height, 0.0))
    assert decibel.max() < SILENT_DB if dark else decibel.max() > -20.0


def pixel_places(geometry: str) -> tuple[np.ndarray, np.ndarray]:
    """u, v [mm] of the centres of a picture's pixels, 80 mm deep."""
    radius, reach_deg = {"LINEAR": (0.0, 0.0), "CURVILINEAR": (60.0, 25.0), "PHASED": (0.0, 40.0)}[geometry]
    width = 40.0 if geometry == "LINEAR" else 2 * (radius + 80.0) * np.sin(np.radians(reach_deg))
    above = radius * (1 - np.cos(np.radians(reach_deg)))
    at = (np.arange(PIXELS) + 0.5) / PIXELS
    return np.meshgrid((at - 0.5) * width, at * (80.0 + above) - above)


@pytest.mark.parametrize("geometry", list(GEOMETRIES))
def test_the_picture_is_the_lines_bilinearly_and_black_beyond_them(tank, geometry):
    probe, (u, v) = probe_of(geometry), pixel_places(geometry)
    tank.fill(backscatter=0.1)
    decibel = tank.look(probe, "speckle")
    line, depth = (u / 40.0 + 0.5) * LINES - 0.5, v
    if geometry != "LINEAR":
        start, stop = np.radians([probe.theta_start_deg, probe.theta_stop_deg])
        angle, depth = np.arctan2(u, v + probe.radius_mm), np.hypot(u, v + probe.radius_mm) - probe.radius_mm
        line = (angle - start) / (stop - start) * LINES - 0.5
    # How far within, in lines or samples; float32 may round what lies on the edge either way.
    within = np.minimum.reduce([line + 0.5, LINES - 0.5 - line, depth / 0.125, (80.0 - depth) / 0.125])
    assert (tank.picture[within < -1e-3] == 0).all() and (tank.picture[within > 1e-3] > 0).mean() > 0.9
    assert (within < -1e-3).any() == (geometry != "LINEAR")
    mixed = ndimage.map_coordinates(decibel, [line, depth / 0.125 - 0.5], order=1, mode="nearest")
    wanted = 255 * np.clip(mixed / probe.dyn_range_db + 1, 0, 1)
    # Rounding, and float32 fractions of a sample next to a null of 100 dB.
    assert np.abs(tank.picture - wanted)[within > 1e-3].max() < 1.0


@pytest.mark.parametrize("geometry", list(GEOMETRIES))
@pytest.mark.parametrize("target", [(-13.3, 22.1), (12.2, 55.7)])
def test_a_target_is_drawn_where_it_is(tank, geometry, target):
    tank.fill(
        USUAL, backscatter=lambda x, y, z: 0.5 * np.exp(-((x - target[0]) ** 2 + (y - target[1]) ** 2) / 2)
    )
    tank.look(probe_of(geometry))
    amplitude = 10 ** (tank.picture / 255.0 * 60 / 20) - 1
    u, v = pixel_places(geometry)
    centre = [np.average(u, weights=amplitude), np.average(v, weights=amplitude)]
    assert centre == pytest.approx(target, abs=max(u[0, 1] - u[0, 0], v[1, 0] - v[0, 0]) / 2)


def test_gain_and_its_course_over_depth_are_added(tank):
    sliders = (50.0,) * 4 + (80.0,) * 4
    louder = probe_of(gain_percent=70.0, depth_compensation_db_cm_mhz=0.5, time_gain_compensation=sliders)
    tank.fill(attenuation=0.5, backscatter=0.1)
    for detail_level in ("reflection", "speckle"):
        added = tank.look(louder, detail_level) - tank.look(probe_of(), detail_level)
        assert np.abs(added - louder.gain_db()).max() < 1e-3


def test_the_grey_map_bends_the_greys_between_black_and_white(tank):
    tank.fill(attenuation=0.5, backscatter=0.3)
    tank.look(probe_of())
    linear = tank.picture / 255.0
    tank.look(probe_of(grey_map="dark"))
    # Both are rounded, the linear one before it is bent.
    exponent = GREY_EXPONENTS["dark"]
    rounded = (0.5 + 0.5 * exponent + 0.1) / 255
    assert (
        np.ptp(linear) > 0.5
        and np.abs(tank.picture / 255.0 - linear**exponent).max() < rounded
        and exponent > 1
    )


def test_a_probe_of_other_lines_or_samples_is_refused(tank):
    for other in (probe_of(number_of_scanlines=128), probe_of(number_of_samples_per_scanline=320)):
        with pytest.raises(ValueError, match="for a field of shape"):
            tank.look(other)
    with pytest.raises(ValueError, match="multiple of 16"):
        probe_of(number_of_samples_per_scanline=648)
