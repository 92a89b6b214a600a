"""Irrigation fluid between array and organ: what passes it, how long it takes, and where it couples;
closed forms.
"""

import numpy as np
import pytest
from pulse_oracle import loss_db
from test_bmode import (
    FAT,
    GAS,
    MIRROR,
    TISSUE,
    Tank,
    depths,
    flat_tank,
    interface,
    peaks,
    probe_of,
    speed_ratio,
)

from sim.fields import array_of, fill
from ultrasound.acoustics import acoustic_values
from ultrasound.bmode import BMode
from ultrasound.doppler import Doppler
from ultrasound.propagation import Propagation
from ultrasound.sampled_volume import SampledVolume

GAP_MM = 4.0
WATER = acoustic_values("fluid")
# Of 10 dB/cm/MHz, so that a layer of some millimetres differs from none.
MURKY = (WATER[0], 10.0, 0.0, 0.0)
# The organ is between these planes of y [mm], or from the first on.
THICKNESS_MM = 12.0


def distance_field(value) -> SampledVolume:
    """Signed distances from the organ, a linear function of y and x between voxels of 1 mm."""
    x, y = np.meshgrid(np.arange(-50.0, 51.0), np.arange(-20.0, 101.0), indexing="ij")
    index_from_mm = np.diag([1.0, 1.0, 1e-6, 1.0])
    index_from_mm[:2, 3] = 50.0, 20.0
    return SampledVolume(value(x, y)[:, :, None], index_from_mm, outside=1e6)


def wet(tank: Tank, distance, fluid=WATER, **settings) -> Tank:
    """The tank with an organ, seen through fluid; ``settings`` are those of ``Propagation``."""
    values = dict(contact="organ", contact_gap_mm=GAP_MM, has_fluid=True) | settings
    sound = Propagation(tank.tissue, distance_field(distance), tank.plane, probe_of(), 0.5, **values)
    sound.surface, sound.fluid = MIRROR, fluid
    tank.bmode = BMode(sound, probe_of())
    return tank


def below(x, y):
    """From y = 0 on."""
    return -y


@pytest.fixture(scope="module")
def half_space(one_device) -> Tank:
    return wet(flat_tank(0.5), below)


@pytest.fixture(scope="module")
def murky(one_device) -> Tank:
    return wet(flat_tank(0.5), below, MURKY)


def test_the_fluid_is_water():
    impedance, attenuation, backscatter, anisotropy = WATER
    assert impedance == pytest.approx(1.48, abs=0.02) and attenuation == pytest.approx(0.002)
    assert backscatter < 2e-5 and anisotropy == 0
    # 20 degrees: 1482 m/s; 25 degrees: 1497 m/s.
    assert 1475 < 1540 * speed_ratio(impedance) < 1505


@pytest.mark.parametrize("gap", [1.0, 3.5])
def test_the_delay_is_that_of_the_layer(half_space, gap):
    half_space.fill(impedance=interface(TISSUE, FAT, 0.4))
    probe = probe_of()
    at = peaks(half_space.look(probe, at=(0, -gap, 0)), probe)[0][60:132]
    expected = gap / speed_ratio(WATER[0]) + 40.0 / speed_ratio(TISSUE)
    assert at == pytest.approx(expected, abs=0.15)
    # As if all were tissue, it would be 2 % of the gap less: the layer slows sound.
    assert speed_ratio(TISSUE) / speed_ratio(WATER[0]) > 1.02


@pytest.mark.parametrize("gap", [1.5, 3.5])
def test_the_layer_takes_what_its_attenuation_says(half_space, murky, gap):
    probe, level = probe_of(), {}
    for name, tank in (("clear", half_space), ("murky", murky)):
        tank.fill(impedance=interface(TISSUE, FAT, 0.4))
        level[name] = tank.look(probe, at=(0, -gap, 0))[60:132].max(axis=1).mean()
    expected, clear = (
        loss_db(0.2 * fluid[1] * gap, probe.frequency_mhz, of="echo")[0] for fluid in (MURKY, WATER)
    )
    # The layer is known to half of the distance of tissue samples, 1 mm.
    assert level["clear"] - level["murky"] == pytest.approx(expected, rel=0.5 / gap) and expected > 10
    assert clear < 0.03


@pytest.mark.parametrize("gap", [2.5, 3.5])
def test_no_echo_comes_from_within_it(half_space, gap):
    """Where the CT shows fat that scatters; what is behind the organ's surface does scatter."""
    half_space.fill(impedance=TISSUE, backscatter=0.1)
    probe = probe_of()
    decibel, depth = half_space.look(probe, "speckle", at=(0, -gap, 0))[30:160], depths(probe)
    within, behind = (
        10 * np.log10((10 ** (decibel[:, where] / 10)).mean())
        for where in (depth < gap - 1.2, (depth > gap + 2) & (depth < gap + 10))
    )
    assert behind == pytest.approx(-20, abs=1.5) and within < behind - 50


@pytest.mark.parametrize(("gap", "couples"), [(0.5, 1), (GAP_MM - 0.1, 1), (GAP_MM + 0.1, 0), (8.0, 0)])
def test_an_element_is_coupled_as_far_as_the_layer_reaches(half_space, gap, couples):
    half_space.fill()
    half_space.look(probe_of(), at=(0, -gap, 0))
    assert (array_of(half_space.bmode.sound.contact) == couples).all()


def test_over_a_slope_those_near_enough_are_coupled_and_the_others_are_dark(one_device):
    slope, gap = np.radians(12), 3.0
    tank = wet(flat_tank(0.5), lambda x, y: x * np.sin(slope) - y * np.cos(slope))
    tank.fill(backscatter=0.1)
    probe = probe_of()
    tank.look(probe, "speckle", at=(0, -gap, 0))
    # Along the beam.
    distance = probe.elements()[:, 0] * np.tan(slope) + gap
    contact = array_of(tank.bmode.sound.contact)
    sure = np.abs(distance - GAP_MM) > 0.05
    np.testing.assert_array_equal(contact[sure], (distance <= GAP_MM)[sure])
    assert 0.4 < contact.mean() < 0.9
    decibel = array_of(tank.bmode.decibel)
    near, far = decibel[:40, 40:120].mean(), decibel[-20:, 40:120].mean()
    assert near - far > 60


def test_an_element_beside_the_organ_is_not_coupled(one_device):
    """Though it is nearer to the organ than the layer reaches: the organ is not in front of it."""
    tank = wet(flat_tank(0.5), lambda x, y: np.maximum(x, -y))
    tank.fill()
    probe = probe_of()
    tank.look(probe, at=(0, -1.0, 0))
    assert (array_of(tank.bmode.sound.contact) == (probe.elements()[:, 0] < 0)).all()


def test_inside_the_gap_it_is_as_gel_of_the_same_values(one_device):
    gel = 1.5
    fluid = wet(flat_tank(0.5), below, (gel, 0.0, 0.0, 0.0))
    images = []
    for tank in (fluid, wet(flat_tank(0.5), below, has_fluid=False, around=gel)):
        tank.fill(impedance=interface(TISSUE, FAT, 0.4), attenuation=0.5, backscatter=0.05)
        images.append(tank.look(probe_of(), "speckle", at=(0, -3.0, 0)))
    assert np.array_equal(*images) and np.ptp(images[0]) > 20


@pytest.mark.parametrize(("gap", "has_layer"), [(3.0, True), (8.0, False)])
def test_behind_the_organ_and_without_coupling_is_what_the_ct_shows(one_device, gap, has_layer):
    tank = wet(flat_tank(0.5), lambda x, y: np.abs(y - THICKNESS_MM / 2) - THICKNESS_MM / 2)
    tank.fill(impedance=FAT, attenuation=0.6)
    sound = tank.bmode.sound
    tank.look(probe_of(), at=(0, -gap, 0))
    y = array_of(sound.rest)[..., 1][96, : int(30 / 0.5)]
    impedance = array_of(sound.tissue)[96, : len(y), 0]
    layer = (y > -GAP_MM + 0.1) & (y < -0.1)
    np.testing.assert_allclose(impedance[layer], WATER[0] if has_layer else FAT, rtol=1e-6)
    np.testing.assert_allclose(impedance[(y > 0.1) | (y < -GAP_MM - 0.1)], FAT, rtol=1e-6)
    assert layer.sum() > 2 and (y > THICKNESS_MM + 0.5).any()


def test_gas_in_the_layer_stays_gas(half_space):
    """As in an empty crater: no tissue behind it is seen."""
    behind = []
    for before in (FAT, GAS):
        half_space.fill(impedance=lambda x, y, z, b=before: np.where(y < 0, b, TISSUE), backscatter=0.1)
        behind.append(half_space.look(probe_of(), "speckle", at=(0, -3.0, 0))[60:132, 80:160].mean())
    assert behind[0] - behind[1] > 20


def test_no_blood_flows_in_it(half_space):
    """Where the CT has a vessel in front of the organ, as in the organ itself."""
    flow = SampledVolume(np.zeros((1, 1, 1, 5)), np.diag([1e-6, 1e-6, 1e-6, 1.0]), outside=0.0)
    fill((flow.voxels, np.tile([0.0, 0.3, 0.0, 0.0, 1.0], (8, 1))))
    half_space.fill(backscatter=0.01)
    probe = probe_of()
    half_space.look(probe, "speckle", at=(0, -3.0, 0))
    sound = half_space.bmode.sound
    doppler = Doppler(sound, half_space.bmode, flow)
    doppler.estimate(probe, 0.0)
    y, energy = array_of(sound.rest)[96, :60, 1], array_of(doppler.moment)[96, :60, 2]
    assert energy[y < -0.5].max() < 1e-9 * energy[y > 0.5].max()


def test_beside_a_surface_that_a_scanline_passes_in_the_depth_there_is_no_fluid(one_device):
    """As in the hilum: nearer to the organ than the layer is thick around a depth of 20 mm alone, and
    nowhere inside.
    """
    tank = wet(flat_tank(0.5), lambda x, y: 0.5 * GAP_MM + np.abs(y - 20.0))
    tank.fill(impedance=FAT, attenuation=0.6)
    tank.look(probe_of(), at=(0, -1.0, 0))
    np.testing.assert_allclose(array_of(tank.bmode.sound.tissue)[96, :60, 0], FAT, rtol=1e-6)
