"""The attenuated pulse against sums over its spectrum, and against a Gaussian's closed form."""

import numpy as np
import pytest
from pulse_oracle import NEPER_DB, fwhm_mm, loss_db

from ultrasound.pulse import FWHM_OF_SD, PATH_ENTRIES, PATH_STEP, attenuated_pulse, pulse_spectrum

PATHS = [0, 10, 20, 40, 60]


@pytest.mark.parametrize("frequency", [3.0, 9.0])
def test_losses_and_length_are_those_of_the_spectrum(frequency):
    pulse = attenuated_pulse(frequency, 75.0)
    path_db = np.array(PATHS) * PATH_STEP * NEPER_DB
    # Sums of a thousand frequencies and of twenty times as many.
    assert -pulse.speckle_db[PATHS] == pytest.approx(loss_db(path_db, frequency), abs=0.02)
    assert -pulse.echo_db[PATHS] == pytest.approx(loss_db(path_db, frequency, "echo"), abs=0.02)
    length = [fwhm_mm(path, frequency) for path in path_db]
    assert pulse.axial_sd_mm[PATHS] * FWHM_OF_SD == pytest.approx(length, rel=0.005)
    assert len(pulse.axial_sd_mm) == PATH_ENTRIES


def test_a_narrow_band_loses_what_a_single_frequency_does_and_keeps_its_length():
    narrow = attenuated_pulse(6.0, 20.0)
    # A band of 1.2 MHz, an SD of 0.4 MHz: the centre moves by 0.16 MHz for each Np/MHz, the loss is less by
    # half of that in Np.
    assert narrow.speckle_db[20] == pytest.approx(-NEPER_DB * 6.0, rel=0.03)
    assert narrow.axial_sd_mm[20] == pytest.approx(narrow.axial_sd_mm[0], rel=0.03)


def test_the_spectrum_is_6_db_down_at_the_ends_of_the_band():
    frequency, amplitude = pulse_spectrum(9.0, 75.0)
    cycle = np.abs(np.sinc(frequency / 9.0 - 1) - np.sinc(frequency / 9.0 + 1))
    window = amplitude / np.maximum(cycle, 1e-9)
    ends = np.interp([9.0 * 0.625, 9.0 * 1.375], frequency, window)
    assert ends == pytest.approx([0.5, 0.5], abs=0.01) and window.max() == pytest.approx(1.0)
