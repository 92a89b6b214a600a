"""Doppler against 2 f v cos(theta) / c: a vessel phantom, aliasing, the wall filter, tissue that turns,
colours.
"""

import numpy as np
import pytest
from conftest import rotation_about
from particle_tissue import carried_along
from test_bmode import Tank, flat_tank, probe_of

from sim.fields import array_of, fill
from ultrasound.acoustics import BACKSCATTER, properties
from ultrasound.blood_flow import BEAT_S, SYSTOLE_S
from ultrasound.doppler import AWAY, BLOOD, POWER, STOPPED, TOWARDS, Doppler, doppler_shift_khz, noise_energy
from ultrasound.lateral_kernel import MAX_HALF_WIDTH
from ultrasound.probe import Probe
from ultrasound.propagation import Propagation
from ultrasound.sampled_volume import SampledVolume

SETTINGS = dict(depth_mm=40.0, velocity_scale_cm_s=60.0, wall_filter_cm_s=1.5)
QUIET, BEATS = {"noise_db": -200.0}, 12


class Vessel:
    """A tank in which blood flows everywhere, or within a slab."""

    def __init__(self) -> None:
        self.tank: Tank = flat_tank(0.5)
        self.flow = SampledVolume(np.zeros((1, 1, 1, 5)), np.diag([1e-6, 1e-6, 1e-6, 1.0]), outside=0.0)
        sound = self.tank.bmode.sound
        self.straight = Doppler(sound, self.tank.bmode, self.flow)
        steered = Propagation(
            sound.tissue_volume,
            sound.organ,
            sound.plane,
            probe_of(),
            0.5,
            contact="tissue",
            contact_gap_mm=1.0,
        )
        self.steered = Doppler(steered, self.tank.bmode, self.flow)

    def set_flow(self, velocity_m_s, resistive_index=0.0, amplitude=1.0) -> None:
        fill((self.flow.voxels, np.tile([*velocity_m_s, resistive_index, amplitude], (8, 1))))

    def look(self, probe: Probe, time_s: float = SYSTOLE_S, **settings) -> np.ndarray:
        """Velocities (beats, scanlines, samples) [cm/s] of the middle of the image at the same time of
        several beats.
        """
        self.tank.look(probe, "speckle")
        doppler = self.steered if probe.colour_steering_deg else self.straight
        velocities = []
        for beat in range(BEATS):
            doppler.estimate(probe, time_s + beat * BEAT_S, **settings)
            velocities.append(doppler.velocity_cm_s(probe)[40:150, 8:60])
        return np.stack(velocities)

    def shown(self, probe: Probe, mode: str = "colour", grey: int = 0) -> np.ndarray:
        """The middle of the colour image at systole over an even B-mode image."""
        self.tank.look(probe, "speckle")
        image = np.full((256, 256), grey, np.uint8)
        return self.straight.render(probe, image, mode, SYSTOLE_S)[40:200, 40:200]


@pytest.fixture(scope="module")
def vessel(one_device):
    return Vessel()


@pytest.mark.parametrize("angle", [20, 45, 60, 75, 120])
@pytest.mark.parametrize("speed_cm_s", [12.0, 55.0])
def test_the_velocity_is_that_of_the_doppler_equation(vessel, angle, speed_cm_s):
    probe = probe_of(**SETTINGS)
    vessel.tank.fill(backscatter=0.01)
    turn = np.radians(angle)
    # The angle is between the flow and the direction to the array, which is -y.
    vessel.set_flow(np.array([np.sin(turn), -np.cos(turn), 0.0]) * speed_cm_s / 100)
    velocity = np.median(vessel.look(probe))
    shift_khz = 2 * probe.frequency_mhz * 1e3 * (speed_cm_s / 100) * np.cos(turn) / 1540
    assert doppler_shift_khz(probe, velocity) == pytest.approx(shift_khz, rel=0.05)


def test_blood_echoes_as_a_vessel_in_the_b_mode_image_does():
    shape = 9, 9, 9
    values = properties(np.full(shape, 40, np.float32), np.ones(shape, np.uint8), {1: "vessel"})
    assert float(np.median(values[3:6, 3:6, 3:6, BACKSCATTER])) == pytest.approx(BLOOD, rel=0.01)


@pytest.mark.parametrize("steering", [-15.0, 12.0])
def test_steered_scanlines_see_a_vessel_parallel_to_the_face(vessel, steering):
    vessel.tank.fill(backscatter=0.01)
    vessel.set_flow([0.4, 0.0, 0.0])
    probe = probe_of(**SETTINGS, colour_steering_deg=steering)
    velocity = np.median(vessel.look(probe))
    assert velocity == pytest.approx(-40.0 * np.sin(np.radians(steering)), rel=0.05)
    # Unsteered, nothing passes the wall filter.
    vessel.look(probe_of(**SETTINGS))
    energy = array_of(vessel.straight.moment)[40:150, 8:60, 2]
    assert energy.max() < 2 * STOPPED * 0.01**2


def test_a_velocity_beyond_the_scale_aliases(vessel):
    vessel.tank.fill(backscatter=0.01)
    vessel.set_flow([0.0, -0.7, 0.0])
    probe = probe_of(**SETTINGS)
    assert np.median(vessel.look(probe)) == pytest.approx(70.0 - 2 * 60.0, rel=0.05)


def test_the_scale_ends_where_echoes_of_the_whole_depth_cannot_return_in_time():
    deep = probe_of(depth_mm=200.0, velocity_scale_cm_s=200.0)
    # c / (2 depth) pulses a second; c PRF / (4 f).
    assert deep.velocity_limit_cm_s == pytest.approx(100 * 1540 * (1540 / 0.4) / (4 * 7.5e6))
    assert probe_of(**SETTINGS).velocity_limit_cm_s == 60.0


@pytest.mark.parametrize("share, passed", [(0.5, 0.5**8), (1.0, 0.5), (2.0, 1.0)])
def test_the_wall_filter_stops_what_is_slow(vessel, share, passed):
    vessel.tank.fill()
    vessel.set_flow([0.0, -share * 0.1, 0.0])
    vessel.look(probe_of(**SETTINGS | {"wall_filter_cm_s": 10.0}))
    energy = array_of(vessel.straight.moment)[100, 20:40, 2]
    assert energy == pytest.approx(BLOOD**2 * passed / (1 if share < 2 else 1 + 2.0**-8), rel=0.01)


def test_what_aliases_to_rest_is_stopped_too(vessel):
    vessel.tank.fill()
    vessel.set_flow([0.0, -1.2, 0.0])
    # Twice the limit of 60 cm/s.
    vessel.look(probe_of(**SETTINGS))
    assert array_of(vessel.straight.moment)[40:150, 8:60, 2].max() < 1e-6 * BLOOD**2


def estimated(tank: Tank, flow: SampledVolume, at=(0.0, 0.0, 0.0), **settings) -> tuple[Doppler, Probe]:
    """The estimate of a probe without noise at a place, at systole."""
    doppler, probe = Doppler(tank.bmode.sound, tank.bmode, flow), probe_of(**SETTINGS | settings, **QUIET)
    tank.look(probe, "speckle", at=at)
    doppler.estimate(probe, SYSTOLE_S)
    return doppler, probe


def depths_of(tank: Tank, probe: Probe, values: np.ndarray) -> np.ndarray:
    """Depths [mm] of the values of an estimate along a scanline."""
    return tank.bmode.sound.stride_of(probe) * probe.sample_mm * np.arange(len(values))


def blood_behind(axis: int, voxel_mm: float, count: int) -> SampledVolume:
    """Blood that moves towards the array in the second half of so many voxels along an axis, which begin at
    the middle (x) or at the face (y).
    """
    index_from_mm = np.diag([1e-6, 1e-6, 1e-6, 1.0])
    index_from_mm[axis, axis], index_from_mm[axis, 3] = 1 / voxel_mm, count / 2 if axis == 0 else 0.0
    shape = np.ones(3, int)
    shape[axis] = count
    moves = (np.arange(count) >= count // 2).reshape(*shape, 1)
    return SampledVolume(moves * [0.0, -0.3, 0.0, 0.0, 1.0], index_from_mm, outside=0.0)


def test_tissue_that_turns_turns_its_flow(vessel):
    """Blood that flows to the left at rest, in tissue that is turned by 40 degrees."""
    embedding, move = carried_along()
    move(rotation_about([0, 0, 1], 40.0), np.zeros(3))
    tank = flat_tank(0.5, embedding=embedding)
    tank.fill(backscatter=0.01)
    vessel.set_flow([0.3, 0.0, 0.0])
    small = dict(transducer_width_mm=12.0, depth_mm=16.0)
    doppler, probe = estimated(tank, vessel.flow, (0.0, -8.0, 0.0), **small)
    real, imaginary, _ = np.moveaxis(array_of(doppler.moment)[80:110, 20:40], -1, 0)
    velocity = np.arctan2(imaginary, real) / np.pi * probe.velocity_limit_cm_s
    # Turned, it is (cos 40, sin 40), of which the second is away from the array.
    assert velocity == pytest.approx(-30.0 * np.sin(np.radians(40.0)), rel=0.02)


def test_the_sample_volume_is_as_wide_as_the_beam(vessel):
    """Blood is where x > 0."""
    vessel.tank.fill()
    doppler, probe = estimated(vessel.tank, blood_behind(0, 0.1, 400))
    moment = array_of(doppler.moment)[:, 60, 2]
    weight = array_of(doppler.weight)[60]
    assert weight.sum() == pytest.approx(1.0, abs=1e-5) and 1 < array_of(doppler.half)[60] < MAX_HALF_WIDTH
    estimates = []
    for beat in range(60):
        doppler.estimate(probe, SYSTOLE_S + beat * BEAT_S)
        estimates.append(array_of(doppler.mean)[:, 60, 2])
    mean, wanted = np.mean(estimates, axis=0), np.convolve(moment, weight[::-1], mode="same")
    assert mean[30:160] == pytest.approx(wanted[30:160], abs=0.1 * float(wanted.max()))
    assert np.abs(moment - wanted)[30:160].max() > 0.3 * wanted.max()


def test_blood_of_a_clamped_kidney_rests_and_pulses_otherwise(vessel):
    vessel.tank.fill(backscatter=0.01)
    vessel.set_flow([0.0, -0.4, 0.0], resistive_index=0.6)
    probe = probe_of(**SETTINGS)
    systole, diastole = (np.median(vessel.look(probe, time_s=t)) for t in (SYSTOLE_S, BEAT_S - 1e-4))
    # The error of the median of some thousand independent samples of 4 cm/s each, three times.
    assert systole == pytest.approx(40.0, abs=0.6) and diastole == pytest.approx(16.0, abs=0.6)
    assert np.median(vessel.look(probe, time_s=SYSTOLE_S + 3 * BEAT_S)) == pytest.approx(systole, rel=0.02)
    vessel.look(probe, clamped=True)
    assert array_of(vessel.straight.moment)[40:150, 8:60, 2].max() < 2 * STOPPED * 0.01**2


def test_tissue_is_left_behind_the_wall_filter_as_bright_as_it_is_where_it_is(vessel):
    vessel.tank.fill(backscatter=lambda x, y, z: 0.01 + 1e-4 * y + 5e-5 * x)
    vessel.set_flow([0.0, 0.0, 0.0], amplitude=0.0)
    probe, sound = probe_of(**SETTINGS), vessel.tank.bmode.sound
    vessel.look(probe)
    level = array_of(sound.amplitude).astype(float) * array_of(sound.tissue)[..., 2]
    energy = array_of(vessel.straight.moment)[5:150, 8:60, 2]
    assert (
        energy == pytest.approx(level[5:150, 8:60] ** 2 * STOPPED, rel=1e-4, abs=0)
        and np.ptp(energy) > energy.min()
    )


def test_the_sample_volume_averages_and_keeps_the_energy(vessel):
    """Blood is where y > 20, moving towards the array."""
    vessel.tank.fill()
    doppler, probe = estimated(vessel.tank, blood_behind(1, 0.2, 200))
    energy = array_of(doppler.mean)[60:130, :, 2].mean(axis=0) / BLOOD**2
    depth = depths_of(vessel.tank, probe, energy)
    step = depth[1]
    at = np.interp(0.5, energy[(depth > 15) & (depth < 25)], depth[(depth > 15) & (depth < 25)])
    assert at == pytest.approx(20.0 * 1.54 / 1.5588, abs=step)
    assert energy[depth < 17].max() < 1e-6 and energy[(depth > 23) & (depth < 38)] == pytest.approx(
        1, rel=0.2
    )


@pytest.mark.parametrize("grey, share", [(160, 1.0), (170, 0.0)])
def test_a_bright_b_mode_image_has_priority(vessel, grey, share):
    """From 65 % of white."""
    vessel.tank.fill(backscatter=1e-4)
    vessel.set_flow([0.0, -0.3, 0.0])
    assert (vessel.shown(probe_of(**SETTINGS), grey=grey) != grey).any(axis=-1).mean() == share


@pytest.mark.parametrize("gain, threshold_db", [(0.0, 26.0), (35.0, 12.0), (50.0, 6.0), (60.0, 2.0)])
def test_colour_begins_at_an_energy_that_falls_as_its_gain_rises(vessel, gain, threshold_db):
    """Relative to the noise: 6 dB at a gain of 50 %, and 40 dB less from no gain to all of it."""
    probe = probe_of(**SETTINGS | {"noise_db": -90.0, "colour_gain_percent": gain})
    # Of tissue nothing is left behind the wall filter.
    vessel.tank.fill()
    shown = []
    for above_db in (-2.0, 2.0):
        blood = 10 ** ((threshold_db + above_db) / 10) - 1
        vessel.set_flow([0.0, -0.3, 0.0], amplitude=np.sqrt(blood * noise_energy(probe)) / BLOOD)
        shown.append((vessel.shown(probe) > 0).any(axis=-1).mean())
    # The energy of an estimate has a standard error of 0.5 / sqrt(2 x 10) = 11 %, and 2 dB are 37 or 58 % of
    # it.
    assert shown[0] < 0.02 and shown[1] > 0.9


def test_velocities_within_the_wall_filter_have_no_colour(vessel):
    """Noise alone has any phase: of a filter of 15 cm/s and a limit of 60, a quarter is not shown, though
    all of it is above the threshold.
    """
    vessel.tank.fill()
    vessel.set_flow([0.0, 0.0, 0.0], amplitude=0.0)
    probe = probe_of(**SETTINGS | dict(noise_db=-90.0, colour_gain_percent=100.0, wall_filter_cm_s=15.0))
    # Three standard errors of some 500 independent samples.
    assert (vessel.shown(probe) > 0).any(axis=-1).mean() == pytest.approx(0.75, abs=0.06)


@pytest.mark.parametrize(
    "mode, stops, share, velocity_cm_s, above_db",
    [
        ("colour", TOWARDS, 0.7, 42.0, 30.0),
        ("colour", AWAY, 0.3, -18.0, 30.0),
        ("power", POWER, 0.2, 30.0, 11.0),
        ("power", POWER, 0.8, -30.0, 26.0),
    ],
)
def test_a_colour_is_the_share_of_its_scale(vessel, mode, stops, share, velocity_cm_s, above_db):
    """Of the velocity's limit, 60 cm/s, or of the 25 dB that are shown of the power from 6 dB above the
    noise.
    """
    probe = probe_of(**SETTINGS | {"noise_db": -90.0})
    vessel.tank.fill()
    energy = noise_energy(probe) * (10 ** (above_db / 10) - 1)
    vessel.set_flow([0.0, -velocity_cm_s / 100, 0.0], amplitude=np.sqrt(energy) / BLOOD)
    colour = np.median(vessel.shown(probe, mode).reshape(-1, 3), axis=0)
    at = share * (len(stops) - 1)
    expected = [np.interp(at, np.arange(len(stops)), channel) for channel in stops.T]
    # From one stop to the next, a third of the range, a channel changes by up to 200 levels: half a step of
    # 64 is 5 of them, and 1 % of the range, by which the median of some hundred independent samples is off,
    # is 6.
    assert colour == pytest.approx(np.array(expected), abs=11)


def test_the_error_of_an_estimate_is_that_of_ten_pulses(vessel):
    """Kasai's estimate of N pulses: the autocorrelation has a relative error of 1 / sqrt(N), half of it
    across its phase.
    """
    probe = probe_of(**SETTINGS | {"noise_db": -105.0})
    # 6 dB less in the narrower band, and 10 dB less in the mean of ten pulses.
    assert 10 * np.log10(noise_energy(probe)) == pytest.approx(-105.0 - 6.0 - 10.0)
    vessel.tank.fill()
    vessel.set_flow([0.0, -0.3, 0.0])
    velocity = vessel.look(probe)
    assert noise_energy(probe) < 1e-3 * BLOOD**2
    assert np.std(velocity) / 60.0 * np.pi == pytest.approx(np.sqrt(0.5 / 10), rel=0.15)


def test_beyond_the_clamp_blood_flows_on(vessel):
    """The organ is where y < 15; the clamp is 5 mm from it."""
    y = np.arange(0, 60, 1.0)
    organ = SampledVolume((y - 15.0)[None, :, None], np.diag([1e-6, 1.0, 1e-6, 1.0]), outside=1e6)
    tank = flat_tank(0.5, organ=organ, contact="tissue")
    tank.fill()
    vessel.set_flow([0.0, -0.3, 0.0])
    doppler, probe = estimated(tank, vessel.flow)
    doppler.estimate(probe, SYSTOLE_S, clamped=True)
    energy = array_of(doppler.moment)[90, :, 2]
    depth = depths_of(tank, probe, energy)
    assert (energy[depth < 18] == 0).all() and (energy[(depth > 22) & (depth < 38)] > 0).all()
