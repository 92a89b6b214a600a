"""Reverberation: what is seen by way of gas, tails of metal, repeated echoes, and the array's own
vibration.
"""

import numpy as np
import pytest
from test_bmode import GAS, TISSUE, depths, flat_tank, peaks, probe_of, speed_ratio

from sim.fields import array_of
from ultrasound.interface import Surface
from ultrasound.probe import BUILD_UP_MM
from ultrasound.reverberation import (
    BANDS,
    BUBBLE_AMPLITUDE,
    BUBBLE_SHARE,
    BY_GAS,
    FACE,
    FALL,
    FALL_IN_AIR,
    LENS,
    MORE_IN_AIR_DB,
    ringing,
)
from ultrasound.sampled_volume import SampledVolume

TITANIUM, USUAL = 27.3, 1.58038
SILENT = 1e-9


@pytest.fixture(scope="module")
def tank(one_device):
    return flat_tank(0.5)


def level_of(tank, probe) -> np.ndarray:
    """Added level (scanlines, tissue samples), and the step between these [mm]."""
    tank.look(probe, "speckle")
    return array_of(tank.bmode.reverberation.level), tank.bmode.sound.stride_of(probe) * probe.sample_mm


def test_tissue_without_gas_and_metal_has_no_reverberation(tank):
    tank.fill(lambda x, y, z: np.where(y < 20, 1.4, TISSUE), 0.5, 0.1)
    assert (level_of(tank, probe_of())[0] == 0).all()


@pytest.mark.parametrize("attenuation", [0.0, 0.3])
def test_behind_gas_is_the_mirror_image_of_what_is_in_front_of_it(tank, attenuation):
    """Gas from 30 mm on; a bright layer 22 to 25 mm deep, 5 to 8 mm in front of it."""
    probe = probe_of()
    bright = lambda x, y, z: np.where((y > 22) & (y < 25), 0.1, 0.01)  # noqa: E731
    tank.fill(lambda x, y, z: np.where(y < 30, USUAL, GAS), attenuation, bright)
    level, step = level_of(tank, probe)
    depth = step * np.arange(level.shape[1])
    # Bubbles are here and there.
    middle = np.median(level[40:150], axis=0)
    arrived = array_of(tank.bmode.sound.amplitude)[90]
    surface = arrived[int(28.5 / step)]
    assert (level[:, depth < 29] == 0).all()
    for at, scatter in ((32.0, 0.01), (36.5, 0.1), (45.0, 0.01)):
        mirrored = 60.0 - at
        wanted = BY_GAS * surface**2 / arrived[int(mirrored / step)] * scatter
        assert np.interp(at, depth, middle) == pytest.approx(wanted, rel=0.15)
    # Behind the mirror image of the face, all of it from the face on, which sound has reached by way of the
    # gas.
    wanted = BY_GAS * FACE * surface * np.interp(13.0, depth, arrived) * 0.01
    assert np.interp(73.0, depth, middle) == pytest.approx(wanted, rel=0.15)


def test_harmonics_build_up_once_on_the_way_by_gas(tank):
    tank.fill(lambda x, y, z: np.where(y < 30, USUAL, GAS), 0.2, 0.01)
    plain, step = level_of(tank, probe_of())
    harmonic, _ = level_of(tank, probe_of(harmonics=True))
    behind = slice(int(33 / step), int(50 / step))
    ratio = np.median(harmonic[40:150, behind] / plain[40:150, behind], axis=0)
    assert ratio == pytest.approx(30.0 / (30.0 + BUILD_UP_MM), rel=0.03)


def test_bubbles_are_at_a_share_of_places_and_ring_on(tank):
    tank.bmode.sound.surface = Surface(roughness_mm=0.0, scattered=0.0, scattered_hard=0.7)
    tank.fill(lambda x, y, z: np.where(y < 20, USUAL, GAS))
    level, step = level_of(tank, probe_of())
    depth = step * np.arange(level.shape[1])
    ring = level[:, (depth > 24) & (depth < 50)]
    bubbles = ring.max(axis=1) > SILENT
    # 192 scanlines see 27 cells of 1.5 mm.
    assert bubbles.mean() < 4 * BUBBLE_SHARE
    levels = [level_of(tank, probe_of(transducer_width_mm=width))[0] for width in (15.0, 25.0, 35.0, 45.0)]
    shares = [(values[:, int(30 / step)] > SILENT).mean() for values in levels]
    assert 0.0 < np.mean(shares) < 3 * BUBBLE_SHARE
    ringing_lines = np.concatenate([values[values[:, int(30 / step)] > SILENT] for values in levels])
    fall_db = 20 * np.log10(ringing_lines[:, int(30 / step)] / ringing_lines[:, int(40 / step)])
    assert fall_db == pytest.approx(0.5 * step * (int(40 / step) - int(30 / step)), abs=0.01)
    assert ringing_lines.max() <= BUBBLE_AMPLITUDE * 1.001


def test_the_tail_of_a_clip_falls_by_what_leaves_it_at_each_turn(tank):
    tank.fill(lambda x, y, z: np.where((y > 20) & (y < 23), TITANIUM, USUAL))
    level, step = level_of(tank, probe_of())
    first = int(np.argmax(level[90] > 0))
    assert first * step == pytest.approx(20.0, abs=2 * step)
    reflection = (TITANIUM - USUAL) / (TITANIUM + USUAL)
    # In metal, sound is so much faster that its 3 mm are seen as 0.7 mm; some samples of it are counted.
    fall_db_mm = -20 * np.log10(level[90, first + 4] / level[90, first]) / (4 * step)
    per_turn_db = -40 * np.log10(reflection)
    thickness = per_turn_db / fall_db_mm * speed_ratio(TITANIUM)
    assert thickness == pytest.approx(3.0, abs=step * speed_ratio(TITANIUM))
    assert level[90, first] == pytest.approx(1 - reflection**2, rel=0.3)


def test_clips_beside_each_other_make_no_invalid_number(tank):
    def clips(x, y, z):
        return np.where((y > 20) & (y < 24), np.where((y > 21.5) & (y < 22.5), 20.0, TITANIUM), USUAL)

    tank.fill(clips, 0.0, 0.01)
    level, step = level_of(tank, probe_of())
    assert np.isfinite(level).all() and np.isfinite(array_of(tank.bmode.decibel)).all()
    assert (level[90, int(26 / step) :] > 0).all()


def test_an_interface_at_the_face_is_repeated_within_its_scanline(tank):
    tank.fill(lambda x, y, z: np.where(y < 0.3, USUAL, 6.0))
    probe = probe_of(frequency_mhz=3.0, depth_mm=20.0)
    assert (tank.look(probe, "speckle")[:, 400:] < -150).all()


def test_a_strong_interface_is_seen_once_more_at_twice_its_depth(tank):
    tank.bmode.sound.surface = Surface(roughness_mm=0.0, scattered=0.0, scattered_hard=0.0)
    tank.fill(lambda x, y, z: np.where(y < 25, USUAL, 6.0))
    probe = probe_of()
    decibel = tank.look(probe, "speckle")
    again, reflection = (depths(probe) > 46) & (depths(probe) < 54), (6.0 - USUAL) / (6.0 + USUAL)
    first, _, _ = peaks(decibel, probe)
    second, amplitude, _ = peaks(np.where(again, decibel, -180.0), probe)
    assert amplitude[60:130] == pytest.approx(FACE * reflection**2, rel=0.05)
    assert second[60:130] == pytest.approx(2 * first[60:130], abs=0.05)
    # A weak one is not.
    tank.fill(lambda x, y, z: np.where(y < 25, USUAL, 1.6))
    assert tank.look(probe, "speckle")[90][again].max() < -150


def test_the_array_vibrates_in_the_near_field_longer_in_air(tank):
    probe = probe_of(ringing_db=-30.0)
    air, contact = ringing(probe)
    wavelengths = depths(probe) / probe.wavelength_mm
    assert contact == pytest.approx(10**-1.5 * np.exp(-wavelengths / FALL), rel=1e-5)
    crest = np.argmin(np.abs(wavelengths - LENS))
    trough = np.argmin(np.abs(wavelengths - LENS / 2))
    # Between the two it falls, and the bands go from their least to their most. Half of a sample is 0.3
    # wavelengths: 3 % of the fall each, and of the bands a cosine of 0.36 radians instead of 0: 4 % of the
    # least, 2 % of the most.
    crest_over_trough = np.exp(-LENS / 2 / FALL_IN_AIR) / (1 - 2 * BANDS)
    assert air[crest] / air[trough] == pytest.approx(crest_over_trough, rel=0.12)
    more = 10 ** (MORE_IN_AIR_DB / 20) * np.exp(wavelengths[0] * (1 / FALL - 1 / FALL_IN_AIR))
    assert air[0] / contact[0] == pytest.approx(more, rel=0.05)
    tank.fill(USUAL)
    echo = 10 ** (tank.look(probe, "speckle")[60:130] / 20)
    # All scanlines vibrate alike: the beam's width does not matter.
    assert np.median(echo[:, :30], axis=0) == pytest.approx(contact[:30], rel=0.02)
    nowhere = SampledVolume(np.full((1, 1, 1), 9.0), np.diag([1e-6, 1e-6, 1e-6, 1.0]))
    in_air = flat_tank(0.5, organ=nowhere, contact="organ")
    in_air.fill(USUAL)
    echo = 10 ** (in_air.look(probe, "speckle")[60:130] / 20)
    assert np.median(echo[:, :60], axis=0) == pytest.approx(air[:60], rel=0.02)
    quiet = ringing(probe_of(ringing_db=-30.0, harmonics=True))
    assert quiet == pytest.approx(0.1 * np.stack([air, contact]), rel=1e-5)
