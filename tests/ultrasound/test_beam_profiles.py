"""Beam profiles against closed forms: a focused aperture without apodization, far from the face."""

import numpy as np
import pytest
from scipy import optimize

from ultrasound.beam import (
    elevation_profiles,
    half_apertures_mm,
    lateral_profiles,
    summed_frequencies,
)
from ultrasound.lateral_kernel import clutter_weights
from ultrasound.probe import Probe, load_probe
from ultrasound.pulse import FWHM_OF_SD

NAMES = ("drop-in", "linear", "curvilinear", "phased")


def width_mm(probe: Probe, scanline: float, depth: float) -> float:
    lag = np.linspace(-60, 60, 2401)
    profile = lateral_profiles(probe, scanline, np.array([depth]), lag)[0]
    above = lag[profile >= 0.5 * profile.max()]
    return float(np.ptp(above) * probe.line_spacing_mm(np.array([depth]))[0])


def middle(probe: Probe) -> float:
    return (probe.number_of_scanlines - 1) / 2


@pytest.mark.parametrize("name", ["drop-in", "linear"])
def test_at_the_focus_the_beam_is_the_square_of_a_sinc(name):
    probe = load_probe(name)
    # sinc^2(w D / (2 wavelength F)) is half at 0.886 wavelengths times f-number. Elements radiate less to the
    # side, which makes the aperture a little smaller; the mean over the pulse's frequencies is wider by some
    # per cent.
    wanted = 0.886 * probe.wavelength_mm * probe.f_number
    assert width_mm(probe, middle(probe), probe.focus_mm) == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize("name", ["drop-in", "linear"])
def test_harmonics_have_the_square_of_the_beam_of_half_the_frequency_and_less_side_lobes(name):
    probe = load_probe(name)
    harmonic = probe.model_copy(update={"harmonics": True})
    # Transmitted sinc^2 of half the frequency, received sinc.
    half = optimize.brentq(lambda t: np.sinc(t / 2) ** 2 * np.sinc(t) - 0.5, 0.1, 0.9)
    wanted = 2 * half * probe.wavelength_mm * probe.f_number
    assert width_mm(harmonic, middle(probe), probe.focus_mm) == pytest.approx(wanted, rel=0.1)
    depth = np.array([probe.focus_mm])
    plain, less = (clutter_weights(setting, depth).sum() for setting in (probe, harmonic))
    assert less < 0.5 * plain


def test_the_beams_of_a_curved_array_are_alike():
    """As far from its ends as their apertures reach: turned about its middle, one is the other."""
    probe, lag, depth = load_probe("curvilinear"), np.linspace(-60, 60, 241), np.array([20.0, 60.0])
    one, other = (lateral_profiles(probe, middle(probe) + n, depth, lag) for n in (0, 50))
    # Float32 phases of 60 mm are right to 0.001 of a radian.
    assert other == pytest.approx(one, abs=1e-3)


def test_the_beam_is_wider_at_the_arrays_end_and_where_it_is_steered():
    probe = load_probe("drop-in")
    # At the end, half of the aperture is left.
    ratio = width_mm(probe, probe.number_of_scanlines - 1, 18.0) / width_mm(probe, middle(probe), 18.0)
    assert 1.6 < ratio < 2.2
    phased = load_probe("phased")
    share = (38.0 - phased.theta_start_deg) / (phased.theta_stop_deg - phased.theta_start_deg)
    steered = width_mm(phased, share * phased.number_of_scanlines - 0.5, phased.focus_mm)
    # The aperture's projection is shorter by the cosine.
    assert steered / width_mm(phased, middle(phased), phased.focus_mm) == pytest.approx(
        1 / np.cos(np.radians(38.0)), rel=0.05
    )


@pytest.mark.parametrize("name", NAMES)
def test_apertures_grow_with_depth_and_frequencies_stand_for_the_pulse(name):
    probe = load_probe(name)
    transmit, receive = half_apertures_mm(probe, np.array([1.0, 10.0, 20.0]))
    assert (np.diff(receive) >= 0).all() and np.ptp(transmit) == 0
    frequency, share = summed_frequencies(probe)
    assert share.sum() == pytest.approx(1.0) and frequency @ share == pytest.approx(
        probe.frequency_mhz, rel=0.05
    )


@pytest.mark.parametrize("name", NAMES)
def test_across_the_plane_the_beam_at_the_lens_focus_is_the_square_of_a_sinc(name):
    probe = load_probe(name)
    focus, height = probe.elevation_focus_mm, probe.element_height_mm
    thickness, correlation = elevation_profiles(probe, np.array([focus, 1.8 * focus]))
    wanted = 0.886 * probe.wavelength_mm * focus / height
    # sinc^2 correlates with itself as (its transform, a triangle, squared): intensity by half at 0.414 of the
    # same unit.
    assert thickness[0] * FWHM_OF_SD == pytest.approx(wanted, rel=0.1)
    shift = np.linspace(0, 1, 1001)
    frequency = np.linspace(-1, 1, 2001)
    triangle = (1 - np.abs(frequency)) ** 2
    together = np.array([(triangle * np.cos(2 * np.pi * frequency * lag)).sum() for lag in shift])
    half = np.interp(-0.5, -((together / together[0]) ** 2), shift) * probe.wavelength_mm * focus / height
    assert correlation[0] * np.sqrt(2 * np.log(2)) == pytest.approx(half, rel=0.1)
    # Behind the focus the slice is thicker, but the speckle hardly longer.
    assert thickness[1] > 1.5 * thickness[0] and correlation[1] < 1.4 * correlation[0]
