"""IQ and RF signals: phases of motion along the beam, the carrier, positions of the tissue, files."""

import numpy as np
import pytest
from conftest import rotation_about
from scipy import io, signal
from test_bmode import BOUNDLESS, Tank, probe_of, speed_ratio

from ultrasound.bmode import Wavefront
from ultrasound.iq_signal import RF_PER_PERIOD, iq_signal, rf_of, save_iq
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane, image_plane, pose_at

SETTINGS = dict(depth_mm=20.0, transducer_width_mm=16.0, focus_depth_percent=50.0)


@pytest.fixture(scope="module")
def tank(one_device):
    tank = Tank((BOUNDLESS,) * 3, (1, 1, 1), (0.0, 0.0, 0.0))
    tank.fill(1.5804, 0.0, 0.1)
    return tank


def plane_at(probe: Probe, at) -> ImagePlane:
    pose = pose_at(at, (0, 1, 0), (1, 0, 0), probe.housing_mm[2])
    return image_plane(pose, probe.housing_mm[2], *probe.extent_mm)


def look(tank: Tank, probe: Probe, at, first=(0, 0, 0)) -> tuple[np.ndarray, np.ndarray]:
    """IQ (scanlines, samples) and rest positions of a probe at a place; phases are those of another place."""
    tank.look(probe, "speckle", at)
    plane = np.asarray(plane_at(probe, first).world_from_plane, float)
    return tank.bmode.iq_of_last(probe, Wavefront.of(probe, plane))


@pytest.mark.parametrize("geometry", ["LINEAR", "CURVILINEAR"])
@pytest.mark.parametrize("towards_mm", [0.004, -0.01])
def test_motion_along_the_beam_turns_the_phase_by_two_wavenumbers(tank, geometry, towards_mm):
    probe = probe_of(geometry, **SETTINGS) if geometry == "LINEAR" else probe_of(geometry, depth_mm=20.0)
    before, _ = look(tank, probe, (0, 0, 0))
    after, _ = look(tank, probe, (0, towards_mm, 0))
    middle = slice(90, 102) if geometry == "LINEAR" else slice(104, 108)
    phase = np.angle((after * before.conj())[middle, 60:600].sum())
    # The tissue is nearer by as much as the probe moved towards it: the echo is earlier.
    assert phase == pytest.approx(2 * 2 * np.pi / probe.wavelength_mm * towards_mm, rel=0.05)


@pytest.mark.parametrize("impedance", [1.38, 1.62])
def test_tissue_that_slows_sound_turns_the_phase_further_and_keeps_the_frequency(tank, impedance):
    probe = probe_of(**SETTINGS)
    tank.fill(impedance, 0.0, 0.1)
    before, _ = look(tank, probe, (0, 0, 0))
    after, _ = look(tank, probe, (0, 0.004, 0))
    tank.fill(1.5804, 0.0, 0.1)
    middle = slice(90, 102), slice(60, 600)
    phase = np.angle((after * before.conj())[middle].sum())
    assert phase == pytest.approx(4 * np.pi / probe.wavelength_mm * 0.004 / speed_ratio(impedance), rel=0.05)
    # Phase from sample to sample: at the centre frequency, none.
    step = np.angle((before[middle][:, 1:] * before[middle][:, :-1].conj()).sum())
    assert abs(step) * 1.54 / (4 * np.pi * probe.sample_mm) < 0.01 * probe.frequency_mhz


@pytest.mark.parametrize("geometry", ["LINEAR", "CURVILINEAR"])
def test_the_angle_to_a_wavefront_is_that_of_the_turn_or_of_the_way_around_the_apex(geometry):
    probe = probe_of(geometry, depth_mm=40.0)
    first = np.asarray(plane_at(probe, (0, 0, 0)).world_from_plane, float)
    wavefront = Wavefront.of(probe, first)
    assert wavefront.angle_deg(probe, first) < 1e-3
    turned = first.copy()
    turned[:3, :3] = rotation_about([0, 0, 1], 4.0) @ first[:3, :3]
    angle = wavefront.angle_deg(probe, turned)
    # Turned about the middle of the face, 20 mm above the middle of the image and, of a curved array, 60 mm
    # below the apex.
    assert angle == pytest.approx(4.0 if geometry == "LINEAR" else 4.0 * 60 / 80, rel=0.05)


def test_the_signal_is_that_of_the_image(tank):
    probe = probe_of(**SETTINGS)
    decibel = tank.look(probe, "speckle")
    plane = np.asarray(plane_at(probe, (0, 0, 0)).world_from_plane, float)
    iq, rest = tank.bmode.iq_of_last(probe, Wavefront.of(probe, plane))
    # At the place of reference the phase of all scanlines turns alike: it changes no magnitude, but for
    # rounding of 0.1 rad.
    level = 20 * np.log10(np.abs(iq) + 1e-9)
    assert np.median(np.abs(level - decibel + probe.gain_db())) < 0.01
    u, depth = probe.scanlines()[0][:, 0], (np.arange(640) + 0.5) * probe.sample_mm
    np.testing.assert_allclose(rest[..., 0], np.broadcast_to(u[:, None], rest.shape[:2]), atol=1e-3)
    np.testing.assert_allclose(rest[..., 1], np.broadcast_to(depth, rest.shape[:2]), atol=1e-2)


def test_rf_has_the_centre_frequency_and_the_envelope_of_iq(tank):
    probe = probe_of(**SETTINGS)
    iq, _ = look(tank, probe, (0, 0, 0))
    rf, sampling_mhz = rf_of(iq.T, probe)
    assert sampling_mhz == pytest.approx(RF_PER_PERIOD * probe.frequency_mhz, rel=1e-3)
    power = (np.abs(np.fft.rfft(rf, axis=0)) ** 2).sum(axis=1)
    frequency = np.fft.rfftfreq(len(rf), 1 / sampling_mhz)
    assert np.average(frequency, weights=power) == pytest.approx(probe.frequency_mhz, rel=0.02)
    envelope = np.abs(signal.hilbert(rf, axis=0))
    at = np.interp(np.arange(640) + 0.5, np.arange(len(rf)) * 640 / len(rf) + 0.5, np.arange(len(rf)))
    there = np.abs(envelope[np.rint(at).astype(int)])[40:600]
    assert np.corrcoef(there.ravel(), np.abs(iq.T)[40:600].ravel())[0, 1] > 0.95


@pytest.mark.parametrize("suffix", ["npz", "mat"])
def test_files_have_the_sampling_and_the_motion_of_the_tissue(tank, tmp_path, suffix):
    probe = probe_of(**SETTINGS)
    iq, rest = look(tank, probe, (1.0, 0.0, 0.25))
    planes = plane_at(probe, (1.0, 0.0, 0.25)), plane_at(probe, (0, 0, 0))
    written = iq_signal(iq, rest, probe, *planes)
    save_iq(written, tmp_path / f"a.{suffix}", suffix)
    # No date, and no name of the machine.
    assert suffix == "npz" or b"reated on" not in (tmp_path / "a.mat").read_bytes()[:128]
    arrays = np.load(tmp_path / "a.npz") if suffix == "npz" else io.loadmat(tmp_path / "a.mat")
    assert arrays["iq"].shape == (640, 192) and np.iscomplexobj(arrays["iq"]) and (arrays["iq"] == iq.T).all()
    assert float(np.squeeze(arrays["iq_sampling_mhz"])) == pytest.approx(1.54 / 2 / (20 / 640))
    # The probe moved by 1 mm to its marked side and 0.25 mm across the plane: the tissue moved the other way.
    across = planes[0].world_from_plane[2, 2] * 0.25
    motion = arrays["motion_mm"].reshape(-1, 3)
    np.testing.assert_allclose(motion, np.broadcast_to([-1.0, 0.0, -across], (640 * 192, 3)), atol=1e-4)
    assert (iq_signal(iq, rest, probe, planes[0], None).motion_mm == 0).all()
