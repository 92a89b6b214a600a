"""Echoes of real scanners: each part against synthetic data whose truth is known, and on the recordings,
where they are.
"""

import json

import numpy as np
import pytest
import SimpleITK as sitk
from study_runs import written

import app
from studies.echo.echo_phantom import EchoPhantom
from studies.image_quality import RAYLEIGH_SNR
from studies.scanner import grey_maps, recorded_speckle, ring_down, rotating_disc, wire_widths
from studies.scanner.recordings import (
    BK_IQ,
    BK_PICTURE,
    DISC,
    LINEAR_IQ,
    LINEAR_PICTURE,
    WIRES,
    WIRES_CONFIGURATION,
    ChannelData,
    RecordingError,
    read_channel_data,
    read_iq,
    read_picture,
)
from ultrasound.doppler import autocorrelation
from ultrasound.probe import load_probe
from ultrasound.reverberation import BANDS, FALL_IN_AIR, LENS
from ultrasound.sweep_file import read_sweep

pytest.importorskip("pymust")


@pytest.fixture
def recordings(data):
    """The folder of recordings."""
    if not (data / "us").is_dir():
        pytest.skip("no ../shared/data/us here")
    return data / "us"


def channel_data(rf=None) -> ChannelData:
    return ChannelData(
        np.zeros((334, 128, 32)) if rf is None else rf, 20e6, 5e6, 60.0, 0.298e-3, 9.95e-6, 1e4, 1480.0
    )


def test_the_autocorrelation_is_that_of_a_turning_phase():
    phase, amplitude = 0.7, np.array([1.0, 3.0])
    echoes = amplitude[:, None] * np.exp(1j * phase * np.arange(12))
    moments = autocorrelation(echoes)
    assert np.arctan2(moments[:, 1], moments[:, 0]) == pytest.approx([phase] * 2)
    assert moments[:, 2] == pytest.approx(amplitude**2)
    assert np.hypot(moments[:, 0], moments[:, 1]) == pytest.approx(amplitude**2)


class TestRotatingDisc:
    def test_our_doppler_finds_a_known_rotation(self, device):
        """IQ of scatterers everywhere whose phase turns by the rotation's axial velocity: 4 pi f v / (c
        PRF) from pulse to pulse.
        """
        data = channel_data()
        phantom = EchoPhantom(rotating_disc.probe_of(data))
        x = phantom.probe.elements()[:, 0] / 1e3
        count = phantom.bmode.sound.most
        away = 0.05 + 30.0 * x[:, None] * np.ones(count)
        draw = np.random.default_rng(3)
        echoes = draw.standard_normal((len(x), count)) + 1j * draw.standard_normal((len(x), count))
        turn = -4 * np.pi * data.centre_hz * away / (data.sound_m_s * data.repetition_hz)
        found = rotating_disc.our_velocity(
            phantom, echoes[..., None] * np.exp(1j * turn[..., None] * np.arange(16))
        )
        # Within 0.74 m/s nothing aliases; the sample volume averages about 1 mm of a velocity that changes by
        # 0.03 m/s.
        inner = slice(10, -10)
        assert found[inner, 4:-4] == pytest.approx(away[inner, 4:-4], abs=0.02)
        fitted = rotating_disc.fitted_rotation(
            *(
                np.broadcast_to(each, found.shape)[inner, 4:-4].ravel()
                for each in (x[:, None], np.arange(count) * 3e-4, found)
            )
        )
        assert fitted.slope_per_s == pytest.approx(30.0, rel=0.01)
        assert fitted.offset_m_s == pytest.approx(0.05, abs=0.002)
        assert abs(fitted.depth_slope_per_s) < 0.1

    def test_a_rotation_is_fitted_by_its_axial_velocity(self):
        x, z = np.random.default_rng(0).uniform(-0.01, 0.01, (2, 500))
        fitted = rotating_disc.fitted_rotation(x, z, 0.04 - 61.0 * x + 0.3 * z)
        assert (fitted.offset_m_s, fitted.slope_per_s, fitted.depth_slope_per_s) == pytest.approx(
            (0.04, -61.0, 0.3)
        )
        assert fitted.residual_m_s == pytest.approx(np.zeros(500), abs=1e-12)

    def test_the_disc_is_where_it_is_bright(self):
        x, z = np.arange(-0.02, 0.02, 3e-4), np.arange(0.0, 0.05, 3e-4)
        distance = np.hypot(x[:, None] - 0.001, z - 0.023)
        within = rotating_disc.disc_of(np.where(distance < 0.01, 1.0, 0.001), x, z)
        assert distance[within].max() < 0.0092 and within[distance < 0.0085].all()

    def test_a_point_is_beamformed_where_it_is(self):
        """One scatterer below the array: a plane wave reaches it after z / c, and each element after its
        distance.
        """
        data = channel_data()
        x, z = (np.arange(128) - 63.5) * data.pitch_m, 0.015
        arrival = (z + np.hypot(x - 0.002, z)) / data.sound_m_s
        time = data.start_s + np.arange(334) / data.sampling_hz
        late = time[:, None] - arrival
        rf = np.cos(2 * np.pi * data.centre_hz * late) * np.exp(-((late * data.centre_hz) ** 2) / 2)
        grid_x, grid_z = np.arange(-0.005, 0.005, 1e-4), np.arange(0.012, 0.018, 1e-4)
        iq = rotating_disc.beamformed(channel_data(np.repeat(rf[..., None], 2, axis=2)), grid_x, grid_z)
        i, j = np.unravel_index(np.argmax(np.abs(iq[..., 0])), iq.shape[:2])
        assert (grid_x[i], grid_z[j]) == pytest.approx((0.002, z), abs=1.5e-4)
        assert iq[i, j, 0] == pytest.approx(iq[i, j, 1])

    def test_the_recorded_disc_turns_as_a_rigid_body(self, device, recordings):
        rotation = rotating_disc.rotation_of(read_channel_data(recordings / DISC))
        # An independent evaluation of the same file: 0.043 + 61.4 x + 0.2 z, median residual 8.6 mm/s.
        assert rotation.slope_per_s == pytest.approx(61.4, rel=0.02)
        assert rotation.offset_m_s == pytest.approx(0.043, abs=0.01)
        assert abs(rotation.depth_slope_per_s) < 0.02 * 61.4
        assert np.median(np.abs(rotation.residual_m_s)) < 0.0086


class TestRingDown:
    def recorded(self, fall=7.0, lens=4.5, bands=0.3, carrier=0.15, noise=1.0):
        """IQ of an array in air: RF of the law's envelope, Q a quarter of the carrier's period later."""
        sample, draw = np.arange(2000) + 0.5, np.random.default_rng(2)

        def ringing(late):
            depth = (sample - late) * carrier / 2
            envelope = 1e3 * np.exp(-depth / fall) * (1 - bands + bands * np.cos(2 * np.pi * depth / lens))
            return envelope * np.cos(2 * np.pi * carrier * (sample - late))

        lines = [
            np.array([ringing(late)] * 64) + noise * draw.standard_normal((64, 2000))
            for late in (0.0, 0.25 / carrier)
        ]
        return lines[0] + 1j * lines[1]

    def test_the_carrier_is_that_of_which_the_delay_is_a_quarter(self):
        assert ring_down.carrier_of(self.recorded()[:, :600]) == pytest.approx(0.15, rel=0.01)

    def test_the_law_is_found(self):
        ring = ring_down.fitted_ring_down(self.recorded(), slice(20, 700), slice(1000, 1900))
        assert (ring.fall, ring.lens, ring.bands) == pytest.approx((7.0, 4.5, 0.3), rel=0.05)
        # I and Q have one half of the noise's energy each.
        assert ring.noise_db == pytest.approx(10 * np.log10(2), abs=0.1)

    def test_our_constants_are_those_of_the_recording(self, recordings):
        ring = ring_down.fitted_ring_down(read_iq(recordings / LINEAR_IQ))
        assert (ring.fall, ring.lens, ring.bands) == pytest.approx((FALL_IN_AIR, LENS, BANDS), rel=0.02)


class TestWires:
    def pictures(self, width=9.0):
        """Six wires, Gaussian, of a full width at half maximum; the two in the middle are wider."""
        row, column = np.indices((200, 300))
        image = np.zeros((200, 300))
        for at, centre, factor in (
            (60, 40, 1),
            (60, 150, 3),
            (60, 260, 1),
            (120, 40, 1),
            (120, 150, 3),
            (120, 260, 1),
        ):
            across = np.exp(-4 * np.log(2) * ((column - centre) / (factor * width)) ** 2)
            image += 240 * across * np.exp(-(((row - at) / 4) ** 2))
        return image.round().astype(np.uint8)[None]

    def test_the_outer_wires_have_their_width_and_depth(self):
        size = wire_widths.PixelSize(0.08, 0.07, 20.0)
        depth, width = wire_widths.wire_widths(self.pictures(), size)
        assert width == pytest.approx([9.0 * 0.08] * 4, rel=0.02)
        assert sorted(depth) == pytest.approx([0.07 * 40.5] * 2 + [0.07 * 100.5] * 2)

    def test_a_picture_with_another_number_of_pieces_is_left_out(self):
        fewer = self.pictures() * (np.arange(300) < 200)
        assert len(wire_widths.wire_widths(fewer.astype(np.uint8), wire_widths.PixelSize(1, 1, 0))[0]) == 0

    def test_our_width_is_that_of_the_profile(self):
        probe = load_probe("linear")
        widths = [wire_widths.beam_width_mm(probe, 24.0, level) for level in (-3.0, -6.0, -20.0)]
        # At the focus two apertures make sinc^2, 1/2 over 0.886 wavelengths f-number; the pulse has lower
        # frequencies too, and elements width.
        assert widths == sorted(widths)
        assert widths[1] == pytest.approx(0.886 * probe.wavelength_mm * probe.f_number, rel=0.15)

    def test_the_recorded_wires_are_no_narrower_than_a_diffraction_limited_beam(self, recordings):
        size = wire_widths.pixel_size(recordings / WIRES_CONFIGURATION)
        assert (size.lateral_mm, size.axial_mm) == pytest.approx((0.0781, 0.0744), abs=1e-4)
        depth, width = wire_widths.wire_widths(read_sweep(recordings / WIRES).images, size)
        assert len(depth) > 100 and depth.min() > 10 and depth.max() < 36
        # A beam of 14 MHz at f/1 would be 0.11 mm wide.
        assert np.median(width) > 0.11


class TestGreyMaps:
    @pytest.mark.parametrize("exponent", [0.25, 0.4])
    def test_a_power_is_found_and_is_not_linear_in_db(self, exponent):
        amplitude = 10 ** np.random.default_rng(0).uniform(0.5, 4, 20_000)
        grey = 250 * (amplitude / 1e4) ** exponent
        found = grey_maps.fitted_grey_map(amplitude, grey)
        assert found.exponent == pytest.approx(exponent, rel=0.01)
        assert found.power_residual < 0.5 < found.linear_residual

    def test_log_compression_is_linear_in_db(self):
        amplitude = 10 ** np.random.default_rng(0).uniform(0, 4, 20_000)
        found = grey_maps.fitted_grey_map(amplitude, 255 * (1 + 20 * np.log10(amplitude / 1e4) / 60))
        assert (
            found.slope == pytest.approx(255 / 60, rel=0.01)
            and found.linear_residual < 0.5 < found.power_residual
        )

    def test_pictures_of_both_recordings_are_the_fourth_root_of_the_amplitude(self, recordings):
        """PLUS's own formula, to the pixel: 20 times the fourth root, truncated, then interpolated and
        rounded.
        """
        iq, picture = read_iq(recordings / BK_IQ), read_picture(recordings / BK_PICTURE)
        line, sample = grey_maps.curved_source(picture, *iq.shape)
        sector = np.isfinite(line)
        grey = np.minimum(20 * np.abs(iq) ** 0.25, 255).astype(np.uint8).astype(float)
        ours = grey_maps.root_at(grey**4, line[sector], sample[sector]) ** 0.25
        assert np.abs(ours - picture[sector]).max() <= 0.51 and (picture[~sector] == 0).all()
        linear = read_iq(recordings / LINEAR_IQ)
        image = read_picture(recordings / LINEAR_PICTURE)[grey_maps.LINEAR_ROWS, grey_maps.LINEAR_COLUMNS]
        predicted = np.minimum(
            20 * grey_maps.root_at(np.abs(linear), *grey_maps.linear_source(len(linear))) ** 0.25, 255
        )
        assert np.corrcoef(predicted.ravel(), image.ravel())[0, 1] > 0.98


class TestCurvedArray:
    @pytest.fixture
    def phantom(self, device):
        return EchoPhantom(recorded_speckle.probe_of(1740), 256)

    def test_our_scan_conversion_puts_samples_where_plus_does(self, phantom):
        """A ramp of dB over depth, one over the scanlines: at each pixel it is that of the picture's own
        geometry.
        """
        probe, picture = phantom.probe, np.zeros((400, 600))
        line, sample = grey_maps.curved_source(picture, probe.number_of_scanlines, 1740)
        inner = (line > 3) & (line < 354) & (sample > 20) & (sample < 1700)
        ramps = np.indices((358, 1740), dtype=float)
        for ramp, place, pixel in ((ramps[0], line, 1.5), (ramps[1], sample, 20.0)):
            # 60 dB over the range, as the grey values have 256 steps of it.
            top = np.percentile(10 ** (60 * (ramp / ramp.max() - 1) / 20), 99)
            amplitude = 10 ** (60 * (ramp / ramp.max() - 1) / 20)
            ours = grey_maps.on_pixels_of(grey_maps.our_picture(amplitude, phantom), phantom, picture)
            expected = 255 * (1 + (60 * (place / ramp.max() - 1) - 20 * np.log10(top)) / 60)
            shown = inner & (expected > 3) & (expected < 250)
            # A grey value, and as much of the ramp as one of our pixels.
            assert np.abs(ours - expected)[shown].max() < 1 + 255 * pixel / ramp.max()

    def test_our_speckle_is_as_even_as_rayleigh_where_that_of_the_recording_is(self, phantom, recordings):
        lines = {
            each.quantity: each
            for each in recorded_speckle.measurements(read_iq(recordings / BK_IQ), phantom)
        }
        for region in recorded_speckle.SPECKLE:
            snr = lines[f"{region.name}: SNR"]
            assert snr.ours == pytest.approx(RAYLEIGH_SNR, rel=0.05)
            # An independent evaluation: 1.75 to 1.88.
            assert 1.70 < snr.recorded < 1.93
        assert lines["dark part beside the grey disc: gCNR"].recorded > 0.9


class TestRecordings:
    def write(self, path, lines, kind="RF_IQ_LINE", orientation="FM"):
        image = sitk.GetImageFromArray(lines[None].astype(np.int16))
        sitk.WriteImage(image, str(path))
        text = path.read_bytes()
        fields = f"UltrasoundImageType = {kind}\nUltrasoundImageOrientation = {orientation}\n".encode()
        path.write_bytes(text.replace(b"ElementDataFile", fields + b"ElementDataFile", 1))

    def test_i_and_q_are_side_by_side_or_a_line_each(self, tmp_path):
        draw = np.random.default_rng(0).integers(-99, 99, (2, 4, 6))
        signal = draw[0] + 1j * draw[1]
        self.write(tmp_path / "a.mha", np.moveaxis(draw, 0, -1).reshape(4, 12))
        assert read_iq(tmp_path / "a.mha") == pytest.approx(signal)
        self.write(tmp_path / "b.mha", np.moveaxis(draw, 0, 1).reshape(8, 6), "RF_I_LINE_Q_LINE", "NM")
        assert read_iq(tmp_path / "b.mha") == pytest.approx(signal[:, ::-1])

    def test_what_is_none_is_refused_in_words(self, tmp_path):
        self.write(tmp_path / "a.mha", np.zeros((4, 4)), "BRIGHTNESS")
        with pytest.raises(RecordingError, match=r"a\.mha: UltrasoundImageType = BRIGHTNESS"):
            read_iq(tmp_path / "a.mha")
        (tmp_path / "b.mha").write_text("nothing")
        with pytest.raises(RecordingError, match=r"b\.mha: cannot be read"):
            read_picture(tmp_path / "b.mha")
        with pytest.raises(RecordingError, match=r"b\.mha: .*PWI_disk"):
            read_channel_data(tmp_path / "b.mha")


class TestCommand:
    def test_it_says_what_it_leaves_out(self, capsys, tmp_path):
        assert app.main(["study", "scanner", "--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
        printed = capsys.readouterr().out
        assert "rotating disc: left out, as pwi_disk/PWI_disk.mat is not there" in printed
        report = json.loads((tmp_path / "out" / "scanner.json").read_text())
        assert len(report["left_out"]) == 5 and report["rows"] == []

    def test_it_writes_what_it_prints(self, recordings, capsys, tmp_path):
        assert app.main(["study", "scanner", "--data", str(recordings), "--out", str(tmp_path)]) == 0
        printed = capsys.readouterr().out
        assert "left out" not in printed
        report, rows = written(tmp_path, "scanner")
        parts = {"rotating disc", "speckle", "grey values", "ring-down in air", "wires"}
        assert {row["part"] for row in report["rows"]} == {row["part"] for row in rows} == parts
        assert all(row["quantity"] in printed for row in rows)
