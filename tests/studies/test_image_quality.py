"""Figures of images against closed forms: Rayleigh speckle, lesions, correlation of filtered noise."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from studies.image_quality import (
    RAYLEIGH_SNR,
    contrast_db,
    correlation_length,
    gcnr,
    grey_figures,
    speckle_snr,
    without_depth_trend,
)


@pytest.fixture
def noise():
    draw = np.random.default_rng(7)
    return draw.standard_normal((400, 400)) + 1j * draw.standard_normal((400, 400))


def test_fully_developed_speckle_has_the_snr_of_rayleigh(noise):
    # SD of the estimate: about 1.6 / sqrt(n), of 160,000 samples 0.004.
    assert (
        speckle_snr(np.abs(noise)) == pytest.approx(RAYLEIGH_SNR, abs=0.016) == pytest.approx(1.91, abs=0.02)
    )
    # A strong coherent part makes it larger, a few bright points smaller.
    assert speckle_snr(np.abs(noise + 5)) > 3
    bright = np.where(np.random.default_rng(1).random((400, 400)) < 0.01, 10, 1)
    assert speckle_snr(np.abs(noise) * bright) < 1.3


def test_a_trend_with_depth_is_removed(noise):
    trend = np.exp(-np.arange(400) / 100)
    assert speckle_snr(np.abs(noise) * trend) < 1.5
    assert speckle_snr(without_depth_trend(np.abs(noise) * trend)) == pytest.approx(RAYLEIGH_SNR, abs=0.02)


@pytest.mark.parametrize("axis", [0, 1])
def test_filtered_noise_correlates_as_its_filter_with_itself(noise, axis):
    # A Gaussian of SD s gives exp(-d^2 / (4 s^2)) of the signal and its square of the intensity: 1/2 at s
    # sqrt(2 ln 2).
    filtered = gaussian_filter1d(noise, 4.0, axis=axis, mode="wrap")
    # 400 / (4 sqrt(pi)) = 56 independent values on each of 400 lines: 1 / sqrt(400 * 56) = 0.7 % of the
    # correlation, which falls by 0.15 a sample there.
    assert correlation_length(np.abs(filtered), axis) == pytest.approx(4.0 * np.sqrt(2 * np.log(2)), rel=0.03)
    assert correlation_length(np.abs(filtered), 1 - axis) < 1.0


def test_what_never_decorrelates_has_no_length():
    assert np.isnan(correlation_length(np.array([[1.0], [2.0], [1.0], [2.0]]) * np.ones(40), 1))


@pytest.mark.parametrize("decibel", [-3.0, -12.0, -25.0])
def test_a_lesion_has_its_contrast_and_the_gcnr_of_two_exponentials(noise, decibel):
    """Intensity of speckle is exponential: the densities of means a < b cross at x = ln(b / a) a b / (b -
    a).
    """
    outside, inside = np.abs(noise[:200]), np.abs(noise[200:]) * 10 ** (decibel / 20)
    ratio = 10 ** (-decibel / 10)
    crossing = np.log(ratio) * ratio / (ratio - 1)
    expected = np.exp(-crossing / ratio) - np.exp(-crossing)
    assert contrast_db(inside, outside) == pytest.approx(decibel, abs=0.1)
    # Of 80,000 values the overlap has an SD of 0.002; empty and full bins add up to 1 / sqrt(800) of the
    # overlap's part.
    assert gcnr(inside, outside) == pytest.approx(expected, abs=0.015)
    # Whatever the grey map.
    assert gcnr(inside**0.25, outside**0.25) == pytest.approx(gcnr(inside, outside), abs=1e-9)


def test_the_gcnr_of_the_same_is_none_and_of_what_does_not_overlap_is_one(noise):
    amplitude = np.abs(noise)
    assert gcnr(amplitude, amplitude) == pytest.approx(0, abs=1e-9)
    assert gcnr(np.full(9, 1.0), np.full(9, 2.0)) == pytest.approx(1)


def test_grey_figures_are_percentiles():
    assert grey_figures(np.arange(101)) == (50, 90)
