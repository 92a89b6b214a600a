"""The echo against closed forms: what tissue takes, reflects and scatters, and how wide a point is drawn."""

import numpy as np
import pytest
from conftest import rotation_about
from particle_tissue import carried_along
from pulse_oracle import fwhm_mm, loss_db
from scipy import special, stats
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from sim.embedding import Unmoved
from sim.fields import array_of, fill
from ultrasound.beam import elevation_profiles, lateral_profiles
from ultrasound.bmode import MAX_HALF_WIDTH, BMode
from ultrasound.interface import Surface
from ultrasound.lateral_kernel import GROUP, clutter_weights
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import image_plane, pose_at
from ultrasound.propagation import Propagation
from ultrasound.sampled_volume import SampledVolume

LINES, SAMPLES, PIXELS = 192, 640, 256
TISSUE, FAT, GAS, STONE = 1.62, 1.38, 4e-4, 6.0
# Of tissue in which sound is as fast as the scanner assumes.
USUAL = 1540 * (0.893 * 1540 - 349) / 1e6
REFLECTION = (TISSUE - FAT) / (TISSUE + FAT)
RUNGS = ["reflection", "speckle", "elevation"]
FWHM = np.sqrt(8 * np.log(2))
# The least that lines hold is 20 log10(1e-9).
SILENT_DB, BOUNDLESS = -179.9, 1e4
# No gain: 0 dB is all of the sound; 0.125 mm a sample, and 0.5 mm from look to look.
SCANNER = dict(
    grey_map="linear", gain_percent=50.0, dyn_range_db=60.0, depth_compensation_db_cm_mhz=0.0, depth_mm=80.0
)
ARRAY = dict(number_of_scanlines=LINES, number_of_samples_per_scanline=SAMPLES, housing_mm=(50.0, 10.0, 20.0))
BEAM = dict(frequency_mhz=7.5, focus_depth_percent=40.0, f_number=3.0, noise_db=-200.0, ringing_db=-200.0)
MIRROR = Surface(roughness_mm=0.0, scattered=0.0, scattered_hard=0.0)
GEOMETRIES = {
    "LINEAR": {"transducer_width_mm": 40.0},
    "CURVILINEAR": {"radius_start_mm": 60.0, "theta_start_deg": -25.0, "theta_stop_deg": 20.0},
    "PHASED": {"transducer_width_mm": 20.0, "theta_start_deg": -40.0, "theta_stop_deg": 40.0},
}
# A picture that lies within a ball of 12 mm but for its corners, of cells small enough to track.
SMALL = dict(transducer_width_mm=16.0, depth_mm=20.0, frequency_mhz=9.0, focus_depth_percent=45.0)


def probe_of(geometry: str = "LINEAR", **settings) -> Probe:
    values = SCANNER | ARRAY | BEAM | GEOMETRIES[geometry] | settings
    return Probe(transducer_name="test", transducer_geometry=geometry, **values)


def depths(probe: Probe) -> np.ndarray:
    return (np.arange(SAMPLES) + 0.5) * probe.sample_mm


class Tank:
    """Tissue that a probe looks into along y, filled anew for each test: so kernels are compiled but once.

    ``voxel_mm`` and ``count`` are of the axes, ``low_mm`` is the first voxel's centre; ``organ`` None is all
    there is.
    """

    def __init__(self, voxel_mm, count, low_mm, embedding=None, organ=None, contact="tissue") -> None:
        self.voxel_mm, voxel_mm, low_mm = voxel_mm[1], np.array(voxel_mm), np.array(low_mm)
        self.at = low_mm[:, None, None, None] + voxel_mm[:, None, None, None] * np.indices(count)
        index_from_mm = np.diag([*(1 / voxel_mm), 1.0])
        index_from_mm[:3, 3] = -low_mm / voxel_mm
        self.tissue = SampledVolume(np.zeros((*count, 4)), index_from_mm, outside=0.0)
        organ = organ or SampledVolume(np.full((1, 1, 1), -1.0), np.diag([1e-6, 1e-6, 1e-6, 1.0]))
        self.plane = PlaneInTissue(embedding or Unmoved(), PIXELS)
        sound = Propagation(self.tissue, organ, self.plane, probe_of(), voxel_mm.min(), contact, 1.0)
        sound.surface = MIRROR
        self.bmode = BMode(sound, probe_of())

    def fill(self, impedance=TISSUE, attenuation=0.0, backscatter=0.0, anisotropy=0.0) -> None:
        """Each a number or a function of x, y, z [mm]."""
        values = np.empty((*self.at[0].shape, 4), np.float32)
        for channel, value in enumerate((impedance, attenuation, backscatter, anisotropy)):
            values[..., channel] = value(*self.at) if callable(value) else value
        more = [(0, n) for n in np.subtract(self.tissue.count, self.tissue.shape)]
        fill((self.tissue.voxels, np.pad(values, [*more, (0, 0)], mode="edge").reshape(-1, 4)))

    def look(
        self, probe, detail_level="reflection", at=(0, 0, 0), along=(0, 1, 0), lateral=(1, 0, 0)
    ) -> np.ndarray:
        """Echoes (lines, samples) [dB] of a probe whose face is at a place and looks along a direction."""
        pose = pose_at(at, along, lateral, probe.housing_mm[2])
        self.plane.locate(image_plane(pose, probe.housing_mm[2], *probe.extent_mm))
        self.picture = self.bmode.render(probe, detail_level)
        return array_of(self.bmode.decibel).astype(float)


def speed_ratio(impedance: float) -> float:
    """Speed of sound over 1.54 mm/us, by Mast's density of it [kg/m3], 0.893 c - 349."""
    return (349 + np.sqrt(349**2 + 4 * 0.893e6 * impedance)) / (2 * 0.893) / 1540


def flat_tank(voxel: float, **settings) -> Tank:
    """Fields of x and y alone: 100 mm wide, from 15 mm behind the probe's face to 90 mm before it."""
    count = (int(100 / voxel), int(105 / voxel), 1)
    return Tank((voxel, voxel, BOUNDLESS), count, (voxel / 2 - 50, -15.0, 0.0), **settings)


@pytest.fixture(scope="module")
def fine(one_device) -> Tank:
    return flat_tank(0.5)


@pytest.fixture(scope="module")
def coarse(one_device) -> Tank:
    return flat_tank(0.9)


@pytest.fixture(scope="module")
def endless(one_device) -> Tank:
    return Tank((BOUNDLESS,) * 3, (1, 1, 1), (0.0, 0.0, 0.0))


def interface(before: float, behind: float, blur_mm: float, tilt_deg: float = 0.0, depth_mm: float = 40.0):
    """A plane step, its normal tilted from y towards x, blurred by a Gaussian."""
    tilt = np.radians(tilt_deg)

    def value(x, y, z):
        across = (y - depth_mm) * np.cos(tilt) + x * np.sin(tilt)
        return before + (behind - before) * special.ndtr(across / blur_mm)

    return value


def peaks(decibel: np.ndarray, probe: Probe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [mm], amplitude and SD [mm] of each line's highest echo: a Gaussian is a parabola in dB, three
    samples tell it.
    """
    i = np.clip(decibel.argmax(axis=1), 1, SAMPLES - 2)
    before, top, behind = (np.take_along_axis(decibel, i[:, None] + k, axis=1)[:, 0] for k in (-1, 0, 1))
    curve = before - 2 * top + behind
    off = (before - behind) / 2 / curve
    amplitude = 10 ** ((top - (before - behind) * off / 4) / 20)
    return (i + 0.5 + off) * probe.sample_mm, amplitude, probe.sample_mm * np.sqrt(-20 / np.log(10) / curve)


def half_width(probe: Probe, depth_mm: float) -> float:
    """Half of the full width at half maximum across the scanlines, in the middle of the array [mm]."""
    lag, middle = np.linspace(0, 40, 401), (LINES - 1) / 2
    profile = lateral_profiles(probe, middle, np.array([depth_mm]), lag)[0]
    return float(np.interp(-0.5, -profile, lag) * probe.line_spacing_mm(np.array([depth_mm]))[0])


@pytest.mark.parametrize("attenuation, frequency", [(0.18, 12.0), (0.5, 5.0), (1.0, 3.0), (1.0, 9.0)])
def test_the_echo_falls_with_depth_as_the_attenuated_spectrum_does(fine, attenuation, frequency):
    probe = probe_of(frequency_mhz=frequency)
    fine.fill(backscatter=0.1)
    lossless = fine.look(probe)
    fine.fill(attenuation=attenuation, backscatter=0.1)
    lost = lossless - fine.look(probe)
    wanted = loss_db(0.2 * attenuation * depths(probe) * speed_ratio(TISSUE), frequency)
    # Between two samples of the tissue amplitude is a chord, and 1e-9 is 0.1 % of an echo at -160 dB.
    seen = wanted < 110
    assert seen.any() and np.abs(lost - wanted)[:, seen].max() < 0.005 * wanted[seen].max() + 0.02
    assert np.abs(lossless + 20.0).max() < 1e-3
    # A single frequency would lose more.
    assert wanted[-1] < 0.95 * 0.2 * attenuation * frequency * depths(probe)[-1]


def test_attenuation_that_grows_with_depth_is_integrated_along_the_beam(fine):
    probe = probe_of(frequency_mhz=5.0)
    fine.fill(backscatter=0.1)
    lossless = fine.look(probe)
    fine.fill(attenuation=lambda x, y, z: 0.03 * np.maximum(y, 0.0), backscatter=0.1)
    lost = lossless - fine.look(probe)
    wanted = loss_db(0.2 * 0.03 / 2 * (depths(probe) * speed_ratio(TISSUE)) ** 2, 5.0)
    deep = (wanted > 20) & (wanted < 110)
    # A trapezoid is exact here; by the attenuation at its end each step would take 0.4 dB more in all. The
    # deepest step loses 1.5 dB: between its ends amplitude is a chord, 0.03 dB above the exponential.
    assert deep.any() and np.abs(lost - wanted)[:, deep].max() < 0.03


@pytest.mark.parametrize("detail_level", RUNGS[1:])
def test_attenuated_speckle_keeps_its_mean_square_and_becomes_longer(fine, detail_level):
    probe, attenuation = probe_of(frequency_mhz=9.0, depth_mm=40.0), 0.7
    fine.fill(backscatter=0.1)
    whole = fine.look(probe, detail_level)
    fine.fill(attenuation=attenuation, backscatter=0.1)
    lost = fine.look(probe, detail_level)
    wanted = loss_db(0.2 * attenuation * depths(probe), 9.0)
    energy = [
        (10 ** (decibel / 10)).reshape(LINES, 8, -1).mean(axis=(0, 2)) for decibel in (whole, lost + wanted)
    ]
    # 80 samples of 192 scanlines are some 1000 resolution cells, mostly of the same scatterers: 0.2 dB.
    assert 10 * np.log10(energy[1] / energy[0]) == pytest.approx(np.zeros(8), abs=0.6)
    for part, path in ((slice(0, 80), 0.0), (slice(560, 640), 0.2 * attenuation * 37.5)):
        intensity = 10 ** ((lost + wanted)[:, part] / 10)
        intensity = intensity - intensity.mean()
        correlation = (intensity[:, 2:] * intensity[:, :-2]).mean() / (intensity**2).mean()
        length = fwhm_mm(path, 9.0) / FWHM
        # As the correlation of speckle below; a taps' sum of noise held over entries.
        assert correlation == pytest.approx(np.exp(-0.5 * (2 * probe.sample_mm / length) ** 2), abs=0.08)


def test_speckle_longer_than_the_longest_kernel_keeps_its_mean_square(fine):
    """Samples of 0.03 mm, and a loss that makes the pulse longer by more than 4 of them: no kernel is
    longer.
    """
    probe, attenuation = probe_of(frequency_mhz=3.0, depth_mm=20.0), 3.0
    fine.fill(backscatter=0.1)
    whole = fine.look(probe, "speckle")
    fine.fill(attenuation=attenuation, backscatter=0.1)
    lost = fine.look(probe, "speckle") + loss_db(0.2 * attenuation * depths(probe), 3.0)
    longer_mm = np.sqrt((fwhm_mm(0.2 * attenuation * 18.0, 3.0) / FWHM) ** 2 - probe.speckle_sd_mm**2)
    assert longer_mm > 4.1 * probe.sample_mm
    energy = [(10 ** (decibel[:, 580:] / 10)).mean() for decibel in (whole, lost)]
    assert 10 * np.log10(energy[1] / energy[0]) == pytest.approx(0.0, abs=1.0)


def mirrored(tilt_deg: float, half_angle_deg: float) -> float:
    """The share of an aperture's rays that a tilted mirror returns to the same aperture, counted."""
    rays = np.linspace(-half_angle_deg, half_angle_deg, 20_001)
    return float((np.abs(2 * tilt_deg - rays) <= half_angle_deg).mean())


@pytest.mark.parametrize("tilt", [0, 3, 6, 8])
@pytest.mark.parametrize("size", ["fine", "coarse"])
def test_the_echo_of_an_interface_has_its_reflection_and_depth(request, size, tilt):
    tank, probe = request.getfixturevalue(size), probe_of()
    u, blur, cosine = probe.scanlines()[0][:, 0], 0.8 * tank.voxel_mm, np.cos(np.radians(tilt))
    lines = np.abs(u) < 8.0
    share = mirrored(tilt, np.degrees(np.arctan(1 / (2 * probe.f_number))))
    for depth in (39.7, 40.0, 40.3):
        tank.fill(interface(FAT, TISSUE, blur, tilt, depth))
        shown, amplitude, width = (values[lines] for values in peaks(tank.look(probe), probe))
        # Looks that differ by less than 3e-4 are no part of it: of a Gaussian's flanks, where the next
        # differs by less than half as much, 6e-4 each of 0.08. Slopes of trilinear voxels point half a degree
        # off, of 9.5.
        assert amplitude == pytest.approx(REFLECTION * share, abs=REFLECTION * (0.06 if tilt else 0.015))
        # Impedance steps by more, relatively, where it is lower: a Gaussian's middle comes R SD / sqrt(pi)
        # nearer, and a voxel widens it by 1 / sqrt(6). One line is off by up to an SD of the pulse, square to
        # the interface.
        nearer = REFLECTION * np.hypot(blur, tank.voxel_mm / np.sqrt(6)) / np.sqrt(np.pi) / cosine
        off = shown * speed_ratio(FAT) - depth + u[lines] * np.tan(np.radians(tilt)) + nearer
        assert abs(off.mean()) < 0.03 and np.abs(off).max() < 1.5 * probe.axial_sd_mm / cosine
        assert width == pytest.approx(probe.axial_sd_mm, rel=1e-3)
        # Equal impedance reflects nothing.
        tank.fill(TISSUE, interface(0.1, 1.0, blur, tilt, depth))
        assert tank.look(probe).max() < SILENT_DB


def test_a_mirror_beyond_the_aperture_is_all_but_invisible(fine):
    fine.fill(interface(FAT, TISSUE, 0.4, 20.0))
    assert peaks(fine.look(probe_of()), probe_of())[1].max() < REFLECTION * 10 ** (-45 / 20)


@pytest.mark.parametrize("tilt", [0, 2, 4])
def test_a_tilt_across_the_image_plane_counts_by_the_elements_height(fine, tilt):
    probe = probe_of(element_height_mm=6.0, elevation_focus_mm=30.0)
    fine.fill(interface(FAT, TISSUE, 0.4, tilt))
    _, amplitude, _ = peaks(fine.look(probe, lateral=(0, 0, 1)), probe)
    # As above; of a half angle of 5.7 degrees.
    wanted = REFLECTION * mirrored(tilt, np.degrees(np.arctan(0.1)))
    assert amplitude == pytest.approx(wanted, abs=0.08 * REFLECTION)


@pytest.mark.parametrize("tilt", [0, 10, 20, 30])
def test_a_rough_interface_is_seen_aslant(fine, tilt):
    probe, rough = (
        probe_of(frequency_mhz=9.0),
        Surface(roughness_mm=0.03, slope=0.14, scattered=0.0, scattered_hard=0.0),
    )
    fine.bmode.sound.surface = rough
    fine.fill(interface(FAT, TISSUE, 0.4, tilt))
    _, amplitude, _ = peaks(fine.look(probe), probe)
    fine.bmode.sound.surface = MIRROR
    # Rays of the aperture, scattered around the mirror's direction by twice the slope in both axes, counted
    # where they return.
    draw, count = np.random.default_rng(1), 400_000
    along, across = np.arctan(1 / (2 * probe.f_number)), np.arctan(probe.element_height_mm / 2 / 25.0)
    back = 2 * np.radians(tilt) + draw.uniform(-along, along, count) + draw.normal(0, 0.28, count)
    aside = draw.uniform(-across, across, count) + draw.normal(0, 0.28, count)
    diffuse = (1 - np.exp(-((4 * np.pi * 0.03 / probe.wavelength_mm) ** 2))) * np.mean(
        (np.abs(back) < along) & (np.abs(aside) < across)
    )
    mirror = np.exp(-((4 * np.pi * 0.03 / probe.wavelength_mm) ** 2) / 2) * mirrored(tilt, np.degrees(along))
    wanted = 20 * np.log10(np.hypot(mirror, np.sqrt(diffuse)))
    # The range of the beam's angles is taken as a Gaussian of the same variance.
    assert 20 * np.log10(amplitude / REFLECTION).mean() == pytest.approx(wanted, abs=1.0)


def test_the_echo_of_a_rough_interface_is_attenuated_too(fine):
    probe = probe_of(frequency_mhz=5.0)
    fine.bmode.sound.surface = Surface(roughness_mm=0.3, scattered=0.5)
    echoes = []
    for attenuation in (0.0, 0.5):
        fine.fill(interface(FAT, TISSUE, 0.4), attenuation)
        echoes.append(fine.look(probe, "speckle")[:, 280:360].max(axis=1))
    fine.bmode.sound.surface = MIRROR
    # So rough that none of it is a mirror's: the echo is speckle, which attenuation leaves as it is, but for
    # a longer pulse.
    assert echoes[0].std() > 3.0
    lost = loss_db(0.2 * 0.5 * 40.0, 5.0, "echo")[0]
    assert (echoes[0] - echoes[1]).mean() == pytest.approx(lost, abs=0.7)


def test_side_lobes_receive_the_energy_beside_the_kernel(fine):
    probe = probe_of()
    fine.fill(backscatter=lambda x, y, z: 0.1 * (x < -6.0))
    fine.look(probe, "speckle")
    sample, groups = 40, LINES // GROUP
    depth = fine.bmode.sound.stride_of(probe) * probe.sample_mm * sample
    weights = clutter_weights(probe, np.array([depth]))[0]
    level = array_of(fine.bmode.level)[:, sample]
    energy = 0.01 * (probe.scanlines()[0][:, 0] < -6.0).reshape(groups, GROUP).mean(axis=1)
    for group in (18, 20, 22):
        received = [weights[other - group + groups - 1] for other in range(groups)]
        wanted = np.dot(received, energy) / (1 + np.sum(received))
        # Between the middles of two groups it is interpolated.
        middle = level[group * GROUP + GROUP // 2 - 1 : group * GROUP + GROUP // 2 + 1]
        assert np.mean(middle**2) == pytest.approx(wanted, rel=0.1) and wanted > 0


def test_an_interfaces_echo_counts_the_elements_in_contact_of_its_aperture(fine):
    """The organ, and so contact, is where x > 0."""
    x = np.arange(-100, 100) * 0.5 + 0.25
    index_from_mm = np.diag([2.0, 1e-6, 1e-6, 1.0])
    index_from_mm[0, 3] = -2.0 * x[0]
    organ = SampledVolume(np.where(x < 0, 5.0, -5.0)[:, None, None], index_from_mm)
    tank = flat_tank(0.5, organ=organ, contact="organ")
    tank.fill(interface(FAT, TISSUE, 0.4))
    probe = probe_of()
    _, amplitude, _ = peaks(tank.look(probe), probe)
    u, reach = probe.scanlines()[0][:, 0], 40.0 / (2 * probe.f_number)
    share = np.clip((u + reach) / (2 * reach), 0, 1)
    inner = (np.abs(u) < 12.0) & (share > 0.15)
    # Transmit and receive lose the same elements. Seven rays stand for the aperture.
    assert np.sqrt(amplitude / REFLECTION)[inner] == pytest.approx(share[inner], abs=0.09)


@pytest.mark.parametrize("size", ["fine", "coarse"])
def test_an_interface_as_sharp_as_a_voxel_is_not_missed_between_samples(request, size):
    tank, probe = request.getfixturevalue(size), probe_of()
    tank.fill(lambda x, y, z: np.where(y < 40.0, FAT, TISSUE))
    true = tank.at[1][tank.at[1] < 40.0].max() + tank.voxel_mm / 2
    for ahead in (0.0, 0.1, 0.2, 0.3, 0.4):
        depth, amplitude, _ = peaks(tank.look(probe, at=(0.0, ahead, 0.0)), probe)
        assert amplitude == pytest.approx(REFLECTION, rel=1e-3)
        # Half of the way from look to look.
        assert np.abs(depth * speed_ratio(FAT) + ahead - true).max() < 0.25


@pytest.mark.parametrize("before, behind", [(0.5, 0.5), (0.5, 10.0), (1.0, 0.01)])
def test_the_echo_of_an_interface_is_attenuated_by_the_tissue_before_it(fine, before, behind):
    probe = probe_of()
    fine.fill(interface(FAT, TISSUE, 0.4), interface(before, behind, 0.4))
    depth, amplitude, _ = peaks(fine.look(probe), probe)
    wanted = REFLECTION * 10 ** (-loss_db(0.2 * before * 40.0, probe.frequency_mhz, "echo")[0] / 20)
    # As at normal incidence above; and depth, to an SD of the pulse, counts by the round trip's loss.
    slack = 0.015 + 0.2 * before * probe.frequency_mhz / 8.69 * probe.axial_sd_mm
    assert amplitude == pytest.approx(wanted, rel=slack)
    assert np.abs(depth * speed_ratio(FAT) - 40.0).max() < 1.5 * probe.axial_sd_mm


@pytest.mark.parametrize("before", [FAT, 1.54, TISSUE])
def test_an_echo_is_displaced_as_the_tissue_before_it_slows_sound(fine, before):
    probe = probe_of()
    fine.fill(lambda x, y, z: np.where(y < 20.0, before, TISSUE) - 0.3 * (y > 50.0))
    decibel = fine.look(probe)
    decibel[:, :280] = SILENT_DB
    depth, _, _ = peaks(decibel, probe)
    # The interface is halfway between voxels, 0.25 mm off; fat of 20 mm displaces it by 1.1 mm.
    true = 20.0 / speed_ratio(before) + 30.0 / speed_ratio(TISSUE)
    assert np.abs(depth - true).max() < 0.25 + 1.5 * probe.axial_sd_mm


@pytest.mark.parametrize("within, more", [(FAT, 0.0), (GAS, 0.0), (STONE, 1.5)], ids=["fat", "gas", "stone"])
def test_behind_a_layer_is_the_shadow_of_its_faces_and_of_what_it_takes(fine, within, more):
    probe = probe_of()

    def share(y):
        """4 mm of it, with flanks of 1 mm."""
        return np.interp(y, [29.5, 30.5, 33.5, 34.5], [0, 1, 1, 0])

    fine.fill(lambda x, y, z: TISSUE + (within - TISSUE) * share(y), lambda x, y, z: more * share(y), 1.0)
    passed = 1 - ((within - TISSUE) / (within + TISSUE)) ** 2
    wanted = 2 * 20 * np.log10(passed) - loss_db(0.2 * more * 4.0, probe.frequency_mhz)[0]
    # A trapezoid over looks is off by 0.5^2 / 8 of a kink at most, at four; float32 holds gas's 1 - R^2 =
    # 1e-3 to 1e-4, and
    # 1e-9 is 0.01 dB of what is left behind it.
    bound = 0.02 + 0.2 * more * probe.frequency_mhz * 4 * 0.5**2 / 8
    assert np.abs(fine.look(probe)[:, 480:] - wanted).max() < bound


def test_behind_a_cyst_the_echo_is_enhanced_by_the_missing_attenuation(fine):
    tissue, cyst, probe = 0.7, 0.01, probe_of()
    # With a rim of 1 mm, which looks 0.5 mm apart see.
    fine.fill(USUAL, lambda x, y, z: cyst + (tissue - cyst) * np.clip(np.hypot(x, y - 30) - 5.5, 0, 1), 0.1)
    u, depth = probe.scanlines()[0][:, 0], depths(probe)[480]
    level = fine.look(probe)[:, 480] + 20.0
    # Rays at even angles from the aperture to the sample, each through its chord of the cyst.
    along = np.linspace(0, depth, 2001)
    amplitude = []
    for slope in (np.arange(-3, 4) / 3.5) / (2 * probe.f_number):
        x, origin = u[:, None] - slope * (depth - along), u - slope * depth
        attenuation = cyst + (tissue - cyst) * np.clip(np.hypot(x, along - 30) - 5.5, 0, 1)
        one_way = 10 ** (-loss_db(0.2 * attenuation.mean(axis=1) * depth, probe.frequency_mhz) / 40)
        amplitude.append(np.where(np.abs(origin) < 20, one_way, np.nan))
    wanted = 40 * np.log10(np.nanmean(amplitude, axis=0))
    # Steps of the tissue samples, 1 mm apart along the beam, over a rim of as much; and trilinear voxels.
    assert np.abs(level - wanted)[np.abs(u) < 15].max() < 0.3
    assert np.ptp(wanted) > 5.0


def test_a_stones_shadow_has_the_penumbra_of_the_aperture(fine):
    """Half of the width is opaque from 18 to 22 mm."""
    probe = probe_of()
    fine.fill(TISSUE, lambda x, y, z: 100.0 * ((x < 0) & (np.abs(y - 20) < 2)), 0.1)
    u, level = probe.scanlines()[0][:, 0], fine.look(probe) + 20.0
    inner = np.abs(u) < 10
    for depth in (30.0, 50.0):
        # Rays of the aperture that pass the stone at its top and at its bottom.
        slope = np.linspace(-1, 1, 1001) / (2 * probe.f_number)
        share = ((u[:, None] > slope * (depth - 22)) & (u[:, None] > slope * (depth - 18))).mean(axis=1)
        amplitude = 10 ** (level[:, int(depth / 0.125)] / 40)
        # Seven rays, and an edge of a voxel.
        assert amplitude[inner] == pytest.approx(share[inner], abs=0.16)
        assert np.abs(amplitude - share)[inner].mean() < 0.04


def test_beyond_the_ct_nothing_reflects(one_device):
    tank = Tank((BOUNDLESS, 0.5, BOUNDLESS), (1, 40, 1), (0, 0.25, 0), contact="organ")
    tank.fill(backscatter=0.1)
    for beyond in (0.3, 2.0):
        decibel, y = tank.look(probe_of(), at=(0.0, -beyond, 0.0)), depths(probe_of()) - beyond
        # At the edges a look is half in, half out.
        assert np.abs(decibel[:, (y > 0.5) & (y < 19.5)] + 20.0).max() < 0.01
        assert decibel.max() < -19.99 and decibel[:, y > 20.5].max() < SILENT_DB


@pytest.mark.parametrize("frequency", [3.0, 5.0, 9.0])
def test_an_interface_has_the_pulses_length_and_the_same_amplitude_at_every_detail_level(fine, frequency):
    probe = probe_of(frequency_mhz=frequency)
    fine.fill(interface(FAT, TISSUE, 0.4))
    for detail_level in RUNGS:
        _, amplitude, width = peaks(fine.look(probe, detail_level), probe)
        assert width == pytest.approx(fwhm_mm(0.0, frequency) / FWHM, rel=2e-3)
        assert amplitude == pytest.approx(REFLECTION, rel=0.015)


@pytest.mark.parametrize("detail_level", RUNGS[1:])
def test_electronic_noise_is_rayleigh_before_gain_and_changes_with_the_pose(endless, detail_level):
    probe = probe_of(noise_db=-60.0, depth_compensation_db_cm_mhz=0.5)
    endless.fill(backscatter=0.0)
    noise = endless.look(probe, detail_level) - probe.gain_db()
    amplitude = 10 ** (noise[::4, ::8].ravel() / 20)
    assert stats.kstest(amplitude, stats.rayleigh(scale=1e-3 / np.sqrt(2)).cdf).pvalue > 0.01
    assert (endless.look(probe, detail_level) - probe.gain_db() == noise).all()
    other = endless.look(probe, detail_level, (0.0, 0.01, 0.0)) - probe.gain_db()
    assert abs(np.corrcoef(10 ** (noise.ravel() / 20), 10 ** (other.ravel() / 20))[0, 1]) < 0.05


@pytest.mark.parametrize("detail_level", RUNGS[1:])
def test_speckle_is_rayleigh(endless, detail_level):
    probe = probe_of()
    endless.fill(backscatter=0.1)
    # Four SD apart intensities correlate by exp(-8).
    along = int(4 * probe.axial_sd_mm / 0.125) + 1
    across = int(4 * 2 * half_width(probe, 80.0) / FWHM / (40.0 / LINES)) + 1
    amplitude = 10 ** (endless.look(probe, detail_level, (3.0, 7.0, 0.4))[::across, ::along].ravel() / 20)
    assert len(amplitude) > 1500
    scale = np.sqrt((amplitude**2).mean() / 2)
    assert stats.kstest(amplitude, stats.rayleigh(scale=scale).cdf).pvalue > 0.01


@pytest.mark.parametrize("geometry", list(GEOMETRIES))
@pytest.mark.parametrize("detail_level", RUNGS[1:])
def test_the_mean_square_of_speckle_is_the_backscatter_squared(endless, geometry, detail_level):
    probe, place = probe_of(geometry), np.random.default_rng(4)
    endless.fill(backscatter=0.1)
    turns = Rotation.random(12, random_state=5).as_matrix()
    echoes = [endless.look(probe, detail_level, place.uniform(-50, 50, 3), *turn[:2]) for turn in turns]
    squares = (10 ** (np.array(echoes) / 10)).mean(axis=0) / 0.1**2
    # What the kernel adds up lies 1.4 entries apart in the mean where lines are dense: noise ends at the
    # borders of blocks of
    # 64, which takes 3 % of it there, and, held over entries, is 5 % short aslant to them. Sampling has an SD
    # of 1 to 3 %.
    inner = squares[MAX_HALF_WIDTH:-MAX_HALF_WIDTH]
    assert inner.mean() == pytest.approx(1.0, abs=0.05)
    assert inner.mean(axis=0).reshape(8, -1).mean(axis=1) == pytest.approx(np.ones(8), abs=0.12)
    # At the array's ends, where half of the kernel has no lines to take from, to 0.6 dB.
    assert [squares[:3].mean(), squares[-3:].mean()] == pytest.approx([1.0, 1.0], abs=0.14)


def test_speckle_correlates_as_the_point_spread_function_does(endless):
    probe = probe_of(depth_mm=40.0)
    endless.fill(backscatter=0.1)
    places = np.random.default_rng(6).uniform(-50, 50, (8, 3))
    intensity = np.stack([10 ** (endless.look(probe, "speckle", at) / 10) / 0.1**2 - 1 for at in places])
    # Scatterers of no correlation, seen with a profile: an echo correlates as the profile with itself, an
    # intensity as the square of that. Noise held over an entry correlates by chords of that, 0.04 off; 3000
    # cells of its block leave an SD of 0.02.
    lags, middle = np.arange(-60, 61), (LINES - 1) / 2
    for axis, first, last in ((2, 0, 300), (1, 40, 160), (1, 200, 310), (1, 500, 620)):
        field = np.moveaxis(intensity[..., first:last], axis, 0)
        profiles = lateral_profiles(probe, middle, depths(probe)[first:last:20], lags)
        together = np.array([np.correlate(profile, profile, "full") for profile in profiles])[:, 120:]
        lateral = ((together / together[:, :1]) ** 2).mean(axis=0)
        if axis == 1:
            field = field[60:132]
        for lag in range(1, 7):
            correlation = (field[lag:] * field[:-lag]).mean() / (field**2).mean()
            axial = np.exp(-0.5 * (lag * probe.sample_mm / probe.speckle_sd_mm) ** 2)
            assert correlation == pytest.approx(lateral[lag] if axis == 1 else axial, abs=0.07)


@pytest.mark.parametrize("axis, tilt", [((1, 0.4, 0.2), 0), ((1, 0.4, 0.2), 62), ((0.1, 1, 0), 75)])
def test_speckle_decorrelates_across_the_plane_as_the_beam_does(endless, axis, tilt):
    """Elevational steps of a sweep, also where the plane is aslant to all axes of the tissue."""
    probe = probe_of(depth_mm=40.0)
    endless.fill(backscatter=0.1)
    turn = rotation_about(axis, tilt)
    across = turn @ [0, 0, 1]
    steps = np.array([0.0, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2])
    draw, curves = np.random.default_rng(8), []
    for origin in draw.uniform(-50, 50, (6, 3)):
        frames = []
        for step in steps:
            place = origin + step * across
            frames.append(
                10 ** (endless.look(probe, "speckle", place, turn @ [0, 1, 0], turn @ [1, 0, 0]) / 10)
            )
        frames = np.array(frames).reshape(len(steps), LINES, 8, -1)
        frames = frames - frames.mean(axis=(1, 3), keepdims=True)
        curves.append((frames * frames[0]).mean(axis=(1, 3)) / (frames[0] ** 2).mean(axis=(0, 2)))
    curves = np.mean(curves, axis=0)
    _, sd = elevation_profiles(probe, (np.arange(8) + 0.5) * 5.0)
    # Six frames of some 100 cells in each part leave an SD of 0.04; where lengths are mixed the curve is a
    # little longer.
    wanted = np.exp(-0.5 * (steps[:, None] / sd) ** 2)
    assert np.abs(curves - wanted)[:, 1:].max() < 0.16
    assert np.abs(curves - wanted)[:, 1:].mean(axis=1).max() < 0.07


@pytest.fixture(scope="module")
def moved(one_device):
    """A tank whose tissue a ball of 12 mm carries along, and what moves it: x -> matrix @ x + shift."""
    embedding, move = carried_along()
    return flat_tank(0.5, embedding=embedding), move


# The body's own origin is where blocks of noise meet: rounding must not choose between two of them there.
@pytest.mark.parametrize("elevation", [0.0, 0.4])
def test_tissue_and_probe_moved_alike_give_the_same_picture(moved, elevation):
    (tank, move), probe = moved, probe_of(**SMALL)
    tank.fill(interface(FAT, TISSUE, 0.4, 25.0, 1.0), 0.5, 0.1)
    turn, shift, face = rotation_about([1, 2, -1], 25), [1.3, -2.1, 0.7], [0, -10, elevation]
    move(np.eye(3), np.zeros(3))
    first = tank.look(probe, "speckle", face)
    move(turn, shift)
    again = tank.look(probe, "speckle", turn @ face + shift, turn @ [0, 1, 0], turn @ [1, 0, 0])
    u, v = np.meshgrid(probe.scanlines()[0][:, 0], depths(probe) - 10.0, indexing="ij")
    # Places are right to 1e-5 mm, noise is held over 0.06 mm: 5 in 10^4 samples take another entry, and ten
    # lines see each.
    assert (np.abs(again - first)[np.hypot(u, v) < 10.5] < 0.01).mean() > 0.99
    assert np.abs(tank.look(probe, "speckle", face) - first).mean() > 3.0


@pytest.mark.parametrize("across, along, shear", [(0.01, -0.03, 0.0), (0.0, -0.01, 0.02)])
def test_tracked_speckle_moves_as_the_tissue_does(moved, across, along, shear):
    (tank, move), probe = moved, probe_of(**SMALL)
    tank.fill(attenuation=0.5, backscatter=0.1)
    strain, shift = np.array([[across, shear, 0], [0, along, 0], [0, 0, 0]]), np.array([-0.3, 0.4, 0.0])
    frames = []
    for share in (0, 1):
        move(np.eye(3) + share * strain, share * shift)
        frames.append(10 ** (tank.look(probe, "speckle", (0.0, -10.0, 0.4)) / 20))
    size = np.array([16.0 / LINES, 20.0 / SAMPLES])
    half, tracked, wanted = (18, 48), [], []
    for place in np.mgrid[-6:6.1:1.5, -6:6.1:1.5].reshape(2, -1).T:
        at = np.rint((place + [8, 10]) / size - 0.5).astype(int)
        block = tuple(slice(i - h, i + h + 1) for i, h in zip(at, half, strict=True))
        blocks = [frame[block] - frame[block].mean() for frame in frames]
        tracked.append(-phase_cross_correlation(*blocks, upsample_factor=20, normalization=None)[0] * size)
        wanted.append(strain[:2, :2] @ ((at + 0.5) * size - [8, 10]) + shift[:2])
    errors, ways = (np.linalg.norm(vectors, axis=1) for vectors in (np.subtract(tracked, wanted), wanted))
    # The skin follows an affine map to strain times the way to a cluster's centre, 2 % of 2 mm; the search
    # steps by 0.004 mm.
    assert errors.mean() < 0.05 and errors.max() < 0.2 < ways.mean()


def test_a_target_off_the_plane_is_dimmed_as_the_thick_plane_weighs_it(one_device):
    # The element is so low that the beam is as thick at every depth as at its focus, nearly; the SD is
    # checked in test_beam_profiles.
    probe = probe_of(element_height_mm=1.5, elevation_focus_mm=40.0)
    tank = Tank((BOUNDLESS, BOUNDLESS, 0.05), (1, 1, 641), (0, 0, -16.0))
    tank.fill(backscatter=0.1)
    uniform = tank.look(probe, "elevation")
    sample = 320
    depth = tank.bmode.sound.stride_of(probe) * probe.sample_mm * np.arange(tank.bmode.sound.most)
    thickness = float(np.interp(depths(probe)[sample], depth, array_of(tank.bmode.sound.slice_sd)))
    for off in (0.0, 0.6, 1.0, 1.2, 2.0):

        def target(z):
            return 1e-4 + 0.5 * np.exp(-0.5 * ((z / thickness - off) / 0.5) ** 2)

        # Gauss-Hermite with three nodes, of the beam's energy: an SD of the amplitude over sqrt(2), times
        # sqrt(3).
        node = thickness * np.sqrt(1.5)
        weighed = np.sqrt(2 / 3 * target(0.0) ** 2 + (target(node) ** 2 + target(-node) ** 2) / 6)
        tank.fill(backscatter=lambda x, y, z: target(z))
        level = (tank.look(probe, "elevation") - uniform)[:, sample]
        assert level == pytest.approx(np.full(LINES, 20 * np.log10(weighed / 0.1)), abs=0.3)


def test_the_incidence_angle_is_that_in_deformed_tissue(moved):
    (tank, move), probe = moved, probe_of(**SMALL)
    tank.fill(interface(FAT, TISSUE, 0.4, 0.0, 1.0))
    # A shear that turns the planes y = const by 5 degrees.
    move(np.array([[1, 0, 0], [np.tan(np.radians(5.0)), 1, 0], [0, 0, 1]]), np.zeros(3))
    _, amplitude, _ = peaks(tank.look(probe, at=(0.0, -10.0, 0.4)), probe)
    # The skin follows the shear to a degree or two, in each tetrahedron in its own way: the interface is
    # where its map says.
    u, pixel = probe.scanlines()[0][80:112, 0], np.array([16.0, 20.0]) / PIXELS
    column, row = (np.rint([u, np.full(32, 11.0)] / pixel[:, None] + [[PIXELS / 2], [0]] - 0.5)).astype(int)
    maps = array_of(tank.plane.embedding.rest_from_plane)[array_of(tank.plane.owner)[row, column]]
    normal = maps[:, 1, :3] / np.linalg.norm(maps[:, 1, :3], axis=1, keepdims=True)
    tilts = np.degrees(np.arctan2(np.abs(normal[:, [0, 2]]), normal[:, [1]]))
    half_angles = np.degrees(np.arctan([1 / (2 * probe.f_number), probe.element_height_mm / 2 / 25.0]))
    wanted = [mirrored(along, half_angles[0]) * mirrored(across, half_angles[1]) for along, across in tilts]
    # Some interfaces lie in two tetrahedra.
    assert np.median(np.abs(amplitude[80:112] / REFLECTION - wanted)) < 0.03
    assert 3.0 < tilts[:, 0].mean() < 7.0 and np.mean(wanted) < 0.7


def test_each_ray_is_turned_by_the_interfaces_on_its_own_path(fine):
    probe = probe_of(f_number=2.0)
    fine.fill(lambda x, y, z: 1.58 + 0.08 * special.ndtr((6.0 - np.hypot(x - 2.0, y - 14.0)) / 0.4))
    fine.look(probe)
    sound = fine.bmode.sound
    turn, depth, offset = (array_of(field) for field in (sound.turn, sound.depth, sound.rays.offset))
    refraction, per_mm = array_of(sound.rays.refraction), array_of(sound.rays.lines_per_mm)
    for ray, line, k in ((0, 100, 60), (1, 120, 55), (3, 96, 50), (6, 80, 65)):
        turned = shift = 0.0
        for j in range(1, k + 1):
            here = np.clip(line - offset[ray, k] + offset[ray, j], 0, LINES - 1)
            turned += turn[here, j]
            shift += turned * (depth[here, j] - depth[here, j - 1]) * per_mm[j]
        assert refraction[ray, line, k] == pytest.approx([turned, shift], abs=1e-4)
    assert np.abs(turn).max() > 0.01


def test_half_of_a_slice_beyond_the_ct_has_the_impedance_of_the_other_half(one_device):
    """The CT ends 0.6 mm beside the image plane, within the slice."""
    tank = Tank((1.0, 1.0, 1.0), (60, 100, 12), (-30.0, -10.0, -11.1))
    tank.fill(USUAL, 0.0, 0.1)
    tank.look(probe_of(depth_mm=60.0), "elevation")
    inside = array_of(tank.bmode.sound.tissue)[20:170, 2:60]
    assert inside[..., 0] == pytest.approx(USUAL, rel=1e-5)
    # Scatterers are only where there is tissue.
    assert inside[..., 2].min() < 0.095


def test_tubules_are_bright_where_the_beam_meets_them_squarely(one_device):
    """Tubules run along the gradient of the distance to the capsule, here at an angle to the beam."""
    corners = np.moveaxis(np.indices((2, 2, 2)), 0, -1) * 200.0 - 100.0
    index_from_mm = np.diag([1 / 200, 1 / 200, 1 / 200, 1.0])
    index_from_mm[:3, 3] = 0.5
    organ = SampledVolume(np.zeros((2, 2, 2)), index_from_mm)
    tank, probe = flat_tank(0.5, organ=organ), probe_of()
    tank.fill(USUAL, 0.0, 0.1, anisotropy=4.0)
    for angle in (0, 30, 60, 90):
        along = np.radians(angle)
        fill((organ.voxels, (corners @ [np.sin(along), np.cos(along), 0.0]).ravel()))
        level = np.median(tank.look(probe)[40:150, 100:500]) + 20.0
        # The mean of sin^2 over all directions is 2/3.
        assert level == pytest.approx(4.0 * (np.sin(along) ** 2 - 2 / 3), abs=0.01), angle


@pytest.mark.parametrize("inside", [1.50, 1.66])
def test_refraction_by_a_cylinder_moves_sound_together_or_apart(fine, inside):
    """Parallel rays through a cylinder of 7 mm, Snell's law at both faces, and their distances over a
    Fresnel zone 20 mm behind it.
    """
    outside, radius, y0, probe = 1.5804, 7.0, 15.0, probe_of(f_number=20.0)
    edge = 0.4

    def cylinder(x, y, z):
        return outside + (inside - outside) * special.ndtr((radius - np.hypot(x, y - y0)) / edge)

    fine.fill(cylinder, 0.0, 0.1)
    decibel = fine.look(probe)
    ratio = speed_ratio(inside) / speed_ratio(outside)
    # The image is displaced by less than 1 mm.
    sample = int(42.0 / probe.sample_mm)
    zone = round(np.sqrt(probe.wavelength_mm * 42.0) / 2 / (40.0 / LINES)) * 40.0 / LINES

    def offset(x):
        half = np.sqrt(np.maximum(radius**2 - x**2, 0))
        incidence = np.arcsin(np.clip(x / radius, -1, 1))
        turn = np.arcsin(np.clip(ratio * np.sin(incidence), -1, 1)) - incidence
        behind = np.arcsin(np.clip(np.sin(incidence) / ratio, -1, 1)) - incidence
        shift = turn * (42.0 - y0 + half) - behind * (42.0 - y0 - half)
        return np.where(np.abs(x) < radius, shift, 0.0)

    u = probe.scanlines()[0][:, 0]
    apart = 1 + (offset(u + zone) - offset(u - zone)) / (2 * zone)
    wanted = -20 * np.log10(np.clip(apart, 1 / 3, 3))
    level = decibel[:, sample] - np.median(decibel[np.abs(u) > 14, sample])
    inner = np.abs(u) < radius - zone - 1.0
    assert np.abs(level - wanted)[inner].max() < 1.0
    # It is a lens; and beside its rays is a shadow, or a bright edge.
    assert (np.median(level[np.abs(u) < 2]) > 0.5) == (inside < outside)
