"""The kernel across the lines against its law, sample by sample."""

import numpy as np
import pytest
import taichi as ti
from test_bmode import LINES, flat_tank, probe_of

from sim.device import start
from sim.fields import array_of
from ultrasound.bmode import HALF_WIDTH_SD, MAX_HALF_WIDTH, lateral_weights
from ultrasound.probe import Probe

GEOMETRIES = {
    "LINEAR": {"transducer_width_mm": 40.0},
    "CURVILINEAR": {"radius_start_mm": 60.0, "theta_start_deg": -25.0, "theta_stop_deg": 20.0},
}


@pytest.fixture(params=GEOMETRIES)
def probe(request) -> Probe:
    """One whose beam widens within few samples, so that half of one is seen."""
    given = dict(transducer_name="test", housing_mm=(80.0, 10.0, 20.0), depth_mm=64.0, focal_zone_mm=3.0)
    settings = given | dict(number_of_scanlines=128, number_of_samples_per_scanline=64, f_number=4.0)
    return Probe(**settings, transducer_geometry=request.param, **GEOMETRIES[request.param])


def width_lines(probe: Probe, depth_mm: float) -> float:
    """What a line's neighbours add to the noise's own width at a depth, as an SD in lines."""
    more = probe.lateral_sd_mm(depth_mm) ** 2 - probe.axial_sd_mm**2
    return np.sqrt(more) / probe.line_spacing_mm(np.array([depth_mm]))[0]


def test_weights_are_a_gaussian_at_the_middle_of_each_sample(probe):
    weights, half, _ = lateral_weights(probe)
    assert weights.sum(axis=0) == pytest.approx(np.ones(64)) and np.array_equal(weights, weights[::-1])
    for sample in range(64):
        width = width_lines(probe, (sample + 0.5) * 1.0)
        assert half[sample] == min(np.ceil(HALF_WIDTH_SD * width), MAX_HALF_WIDTH)
        lag = half[sample]
        assert weights[MAX_HALF_WIDTH + lag, sample] / weights[MAX_HALF_WIDTH, sample] == pytest.approx(
            np.exp(-0.5 * (lag / width) ** 2)
        )
        assert (weights[MAX_HALF_WIDTH + lag + 1 :, sample] == 0).all()


def test_the_speckle_gain_restores_the_mean_square_of_noise(probe):
    weights, _, speckle_gain = lateral_weights(probe)
    lines = np.arange(2 * MAX_HALF_WIDTH + 1)
    for sample in (0, 20, 40, 63):
        apart = (lines[:, None] - lines) * probe.line_spacing_mm(np.array([sample + 0.5]))[0]
        # Noise of the axial width: of white one through a Gaussian of SD s, exp(-d^2 / 4 s^2).
        correlation = np.exp(-(apart**2) / (4 * probe.axial_sd_mm**2))
        mean_square = weights[:, sample] @ correlation @ weights[:, sample]
        assert speckle_gain[sample] ** 2 * mean_square == pytest.approx(1.0)


def test_lines_are_spread_by_all_weights_and_mirrored_at_the_arrays_ends():
    start("cpu")
    tank, probe = flat_tank(0.5), probe_of(focus_depth_percent=70.0, focal_zone_mm=6.0, f_number=2.0)
    tank.fill(backscatter=0.1)
    found = tank.look(probe, "speckle") - probe.gain_db()
    weights, half, speckle_gain = lateral_weights(probe)
    assert half.max() > 8 and np.ptp(half) > 4
    real, imaginary = (array_of(each).astype(float) for each in (tank.bmode.real, tank.bmode.imaginary))
    ti.reset()
    lines = np.arange(LINES)
    echo = np.zeros(real.shape, complex)
    for k in range(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1):
        # The end lines are not doubled, and what is mirrored is conjugate.
        there = np.pad(lines, MAX_HALF_WIDTH, mode="reflect")[lines + MAX_HALF_WIDTH + k]
        turned = np.where(there == lines + k, 1.0, -1.0)[:, None]
        echo += weights[k + MAX_HALF_WIDTH] * (real[there] + 1j * turned * imaginary[there])
    wanted = 20 * np.log10(speckle_gain * np.abs(echo) + 1e-9)
    # Sums of some 20 terms in float32, of which as much as all but a hundredth may cancel.
    seen = np.abs(echo) > 1e-3
    assert seen.mean() > 0.9 and np.abs(found - wanted)[seen].max() < 0.01
