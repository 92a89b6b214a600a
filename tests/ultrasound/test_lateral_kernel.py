"""The kernel across the scanlines: weights, energy, and that the scanlines are summed by it."""

import numpy as np
import pytest
from test_bmode import GEOMETRIES, LINES, flat_tank, probe_of

from sim.fields import array_of
from ultrasound.beam import lateral_profiles
from ultrasound.lateral_kernel import (
    CLASSES,
    GROUP,
    LANES,
    LEAST,
    MAX_HALF_WIDTH,
    clutter_weights,
    lateral_kernel,
    narrowed,
    packet_depths,
    scanline_classes,
)

LAGS = np.arange(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_weights_have_sum_1_and_end_where_the_beam_is_below_a_hundredth(geometry):
    weights, half, _ = lateral_kernel(probe_of(geometry))
    assert weights.sum(axis=-1) == pytest.approx(np.ones(half.shape))
    for place in np.ndindex(half.shape):
        inside = np.abs(LAGS) <= half[place]
        assert (weights[place][~inside] == 0).all()
        # Relative to the scanline itself, which near the array's end is a little less than its neighbour.
        edges = weights[place][inside][[0, -1]] / weights[place].max()
        assert half[place] == MAX_HALF_WIDTH or edges.max() >= 0.9 * LEAST


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_the_speckle_gain_restores_the_mean_square_of_noise(geometry):
    probe = probe_of(geometry)
    weights, _, speckle_gain = lateral_kernel(probe)
    for packet, depth in enumerate(packet_depths(probe)):
        apart = (LAGS[:, None] - LAGS) * probe.line_spacing_mm(np.array([depth]))[0]
        # Of white noise through a Gaussian of SD s: exp(-d^2 / 4 s^2).
        correlation = np.exp(-(apart**2) / (4 * probe.speckle_sd_mm**2))
        for number in range(CLASSES):
            mean_square = weights[number, packet] @ correlation @ weights[number, packet]
            assert speckle_gain[number, packet] ** 2 * mean_square == pytest.approx(1.0)


@pytest.mark.parametrize("sd", [3.0, 6.0])
@pytest.mark.parametrize("noise_sd", [0.5, 2.0])
def test_a_narrowed_kernel_makes_noise_as_wide_as_the_profile(sd, noise_sd):
    kernel = narrowed(np.exp(-0.5 * (LAGS / sd) ** 2), noise_sd)
    together = np.convolve(kernel, np.exp(-0.5 * (LAGS / noise_sd) ** 2), "same")
    width = np.sqrt((together * LAGS**2).sum() / together.sum())
    # Linear between scanlines: wider by some 1 / 12 of their distance squared.
    assert width == pytest.approx(sd, rel=0.03)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_a_class_stands_for_scanlines_as_far_from_the_middle_and_mirrors_the_other_side(geometry):
    probe = probe_of(geometry)
    classes, side = scanline_classes(probe)
    assert (classes == classes[::-1]).all() and (side == -side[::-1]).all()
    assert (np.diff(classes[LINES // 2 :]) >= 0).all() and set(classes) == set(range(CLASSES))
    if geometry == "LINEAR":
        depth = np.array([30.0])
        for scanline in (LINES - 6, 100):
            there = lateral_profiles(probe, scanline, depth, LAGS)[0]
            mirror = lateral_profiles(probe, LINES - 1 - scanline, depth, LAGS)[0]
            assert there[::-1] == pytest.approx(mirror, abs=1e-6)


def test_clutter_is_the_energy_of_the_profile_beyond_the_kernel():
    probe, depth = probe_of(), np.array([16.0, 32.0, 64.0])
    weights = clutter_weights(probe, depth)
    groups = -(-LINES // GROUP)
    assert weights.shape == (3, 2 * groups - 1) and weights[:, groups - 3 : groups + 2] == pytest.approx(0)
    lag = np.arange(-LINES, LINES + 1)
    for row, at in zip(weights, depth, strict=True):
        energy = lateral_profiles(probe, (LINES - 1) / 2, np.array([at]), lag)[0] ** 2
        beyond = np.abs(lag) > MAX_HALF_WIDTH
        # One scanline of two is summed, at depths between which it is interpolated.
        assert row.sum() == pytest.approx(energy[beyond].sum() / energy[~beyond].sum(), rel=0.35)


def test_scanlines_are_summed_by_their_weights_and_mirrored_at_the_arrays_ends(one_device):
    tank, probe = flat_tank(0.5), probe_of(focus_depth_percent=70.0, f_number=2.0)
    tank.fill(backscatter=0.1)
    decibel = tank.look(probe, "speckle") - probe.gain_db()
    weights, half, _ = lateral_kernel(probe)
    assert half.max() > 8 and np.ptp(half) > 4
    real, imaginary = (array_of(field).astype(float) for field in (tank.bmode.real, tank.bmode.imaginary))
    classes, side = scanline_classes(probe)
    packet = np.arange(real.shape[1]) // LANES
    scanlines = np.arange(LINES)
    echo = np.zeros(real.shape, complex)
    for k in range(-MAX_HALF_WIDTH, MAX_HALF_WIDTH + 1):
        # The end lines are not doubled, and what is mirrored is conjugate.
        there = np.pad(scanlines, MAX_HALF_WIDTH, mode="reflect")[scanlines + MAX_HALF_WIDTH + k]
        turned = np.where(there == scanlines + k, 1.0, -1.0)[:, None]
        weight = weights[classes[:, None], packet, (MAX_HALF_WIDTH + side * k)[:, None]]
        echo += weight * (real[there] + 1j * turned * imaginary[there])
    wanted = 20 * np.log10(np.abs(echo) + 1e-9)
    # Sums of some 20 terms in float32, of which as much as all but a hundredth may cancel.
    seen = np.abs(echo) > 1e-3
    assert seen.mean() > 0.9 and np.abs(decibel - wanted)[seen].max() < 0.02
