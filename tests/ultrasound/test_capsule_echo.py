"""The echo of the renal capsule: a line at the surface of parenchyma where no step of impedance is, by the
angle of the beam.
"""

import numpy as np
import pytest
from test_bmode import USUAL, Tank, depths, peaks, probe_of

from sim.fields import fill
from ultrasound.acoustics import CORTEX_DB
from ultrasound.propagation import CAPSULE, CAPSULE_TILT
from ultrasound.sampled_volume import SampledVolume

# Of a ball, whose top is 20 mm below the face of the probe; backscatter of cortex, and its anisotropy, which
# tells parenchyma.
RADIUS, TOP, CORTEX, PARENCHYMA = 25.0, 20.0, 10 ** (CORTEX_DB / 20), 3.0
VOXEL = 1.0
ORGAN_LOW = np.array([-45.0, TOP + RADIUS - 45.0, -45.0])


def distances(middle: float) -> np.ndarray:
    """Distance from the ball whose middle is so far below the face, on the grid of ``organ``."""
    at = ORGAN_LOW[:, None, None, None] + VOXEL * np.indices((90, 90, 90))
    return (
        np.linalg.norm(at - np.array([0, middle, 0])[:, None, None, None], axis=0).astype(np.float32) - RADIUS
    )


@pytest.fixture(scope="module")
def tank(one_device) -> Tank:
    index_from_mm = np.diag([1 / VOXEL] * 3 + [1.0])
    index_from_mm[:3, 3] = -ORGAN_LOW / VOXEL
    organ = SampledVolume(distances(TOP + RADIUS), index_from_mm)
    return Tank((VOXEL,) * 3, (80, 100, 60), (-40.0, -10.0, -30.0), organ=organ)


def fill_ball(
    tank: Tank, impedance=USUAL, backscatter=0.0, anisotropy=PARENCHYMA, middle: float = TOP + RADIUS
) -> None:
    """A ball in gel of its own impedance, of a tissue with an anisotropy."""
    fill((tank.bmode.sound.organ.voxels, distances(middle).ravel()))

    def inside(value):
        return lambda x, y, z: value * (np.sqrt(x**2 + (y - middle) ** 2 + z**2) < RADIUS + 0.5)

    tank.fill(impedance, 0.0, inside(backscatter), inside(anisotropy))


def top_echo(decibel: np.ndarray, probe) -> tuple[np.ndarray, np.ndarray]:
    """Depth [mm] and amplitude of the highest echo of each line in the upper half."""
    upper = np.where(depths(probe) < TOP + RADIUS, decibel, -200.0)
    depth, amplitude, _ = peaks(upper, probe)
    return depth, amplitude


def test_a_line_is_at_the_surface_where_no_step_of_impedance_is(tank):
    probe = probe_of()
    fill_ball(tank)
    depth, amplitude = top_echo(tank.look(probe), probe)
    u = probe.scanlines()[0][:, 0]
    near = np.abs(u) < 6.0
    # Halfway between samples distances are linear; a chord of the ball over a voxel is VOXEL^2 / (8 RADIUS)
    # off.
    surface = TOP + RADIUS - np.sqrt(RADIUS**2 - u**2)
    assert np.abs(depth - surface)[near].max() < probe.sample_mm + VOXEL**2 / 4 / RADIUS + 0.05
    # By the angle between beam and surface, of which the ball's normal is u / R aside; a mirror's and a
    # diffuse part have one energy.
    wanted = CAPSULE * np.exp(-0.5 * (np.arcsin(np.abs(u) / RADIUS) / CAPSULE_TILT) ** 2)
    # Slopes of trilinear voxels point a degree off, at the steepest flank 0.61 / CAPSULE_TILT of it.
    wide = np.abs(u) < 8.0
    assert amplitude[wide] == pytest.approx(
        wanted[wide], abs=0.61 * np.radians(1.0) / CAPSULE_TILT * CAPSULE + 0.005
    )
    # At 20 degrees it is no brighter than cortex, which sonographers expect.
    assert np.exp(-0.5 * (np.radians(20) / CAPSULE_TILT) ** 2) < 10 ** (-15 / 20)


def test_it_is_brighter_than_cortex_where_the_beam_is_square_to_it(tank):
    probe = probe_of()
    fill_ball(tank, backscatter=CORTEX)
    decibel = tank.look(probe, "speckle")
    middle = np.abs(probe.scanlines()[0][:, 0]) < 2.0
    depth = depths(probe)
    line = 10 * np.log10((10 ** (decibel[middle][:, np.abs(depth - TOP) < 0.3] / 10)).mean(axis=1).mean())
    cortex = 10 * np.log10((10 ** (decibel[:, (depth > TOP + 6) & (depth < TOP + 20)][60:130] / 10)).mean())
    # The peak, 0.3 mm to either side of which the mean of a pulse is lower.
    assert line - cortex > 8.0


@pytest.mark.parametrize("anisotropy, has_line", [(0.0, False), (2.0, True)])
def test_without_parenchyma_there_is_no_line(tank, anisotropy, has_line):
    fill_ball(tank, anisotropy=anisotropy)
    assert (tank.look(probe_of()).max() > -30.0) == has_line


def test_it_moves_with_the_organ_and_not_with_the_voxels(tank):
    probe = probe_of()
    middle = np.abs(probe.scanlines()[0][:, 0]) < 1.0
    for off in (0.0, 0.3, 1.4):
        fill_ball(tank, middle=TOP + RADIUS + off)
        depth, _ = top_echo(tank.look(probe), probe)
        assert np.abs(depth[middle] - TOP - off).max() < probe.sample_mm + 0.05
    # The probe nearer by some: the line as much.
    fill_ball(tank)
    depth, _ = top_echo(tank.look(probe, at=(0.0, 3.3, 0.0)), probe)
    assert np.abs(depth[middle] - TOP + 3.3).max() < probe.sample_mm + 0.05
