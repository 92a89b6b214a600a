"""The echo against closed forms: what tissue takes, reflects and scatters, and how wide a point is drawn."""

import numpy as np
import pytest
import taichi as ti
import trimesh
from conftest import rotation_about
from particle_tissue import tissue_of
from scipy import special, stats
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from sim.body import BodyState
from sim.device import start
from sim.embedding import Embedding, Unmoved
from sim.fields import array_of, fill
from ultrasound.bmode import MAX_HALF_WIDTH, BMode
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import image_plane, pose_at
from ultrasound.sampled_volume import SampledVolume
from ultrasound.scanner import PlaneInTissue

LINES, SAMPLES, PIXELS = 192, 640, 256
TISSUE, FAT, GAS, STONE = 1.62, 1.38, 4e-4, 6.0
REFLECTION = (TISSUE - FAT) / (TISSUE + FAT)
RUNGS = ["reflection", "speckle", "elevation"]
FWHM = np.sqrt(8 * np.log(2))
# The least that lines hold is 20 log10(1e-9).
SILENT_DB, BOUNDLESS = -179.9, 1e4
# No gain: 0 dB is all of the sound; 0.125 mm a sample, and 0.5 mm from look to look.
SCANNER = dict(gain_percent=50.0, dyn_range_db=60.0, depth_compensation_db_cm_mhz=0.0, depth_mm=80.0)
ARRAY = dict(number_of_scanlines=LINES, number_of_samples_per_scanline=SAMPLES, housing_mm=(50.0, 10.0, 20.0))
BEAM = dict(frequency_mhz=7.5, focus_depth_percent=40.0, f_number=3.0, bandwidth_percent=75.0)
GEOMETRIES = {
    "LINEAR": {"transducer_width_mm": 40.0},
    "CURVILINEAR": {"radius_start_mm": 60.0, "theta_start_deg": -25.0, "theta_stop_deg": 20.0},
    "PHASED": {"transducer_width_mm": 20.0, "theta_start_deg": -40.0, "theta_stop_deg": 40.0},
}
# A picture that lies within a ball of 12 mm but for its corners, of cells small enough to track.
SMALL = dict(transducer_width_mm=16.0, depth_mm=20.0, frequency_mhz=9.0, focus_depth_percent=45.0)


def probe_of(geometry: str = "LINEAR", **settings) -> Probe:
    given = SCANNER | ARRAY | BEAM | GEOMETRIES[geometry] | settings
    return Probe(transducer_name="test", transducer_geometry=geometry, **given)


def depths(probe: Probe) -> np.ndarray:
    return (np.arange(SAMPLES) + 0.5) * probe.sample_mm


class Tank:
    """Tissue that a probe looks into along y, filled anew for each test: so kernels are compiled but once.

    ``voxel_mm`` and ``count`` are of the axes, ``low_mm`` is the first voxel's centre; ``organ`` None is all there is.
    """

    def __init__(self, voxel_mm, count, low_mm, embedding=None, organ=None, contact="tissue") -> None:
        self.voxel_mm, voxel_mm, low_mm = voxel_mm[1], np.array(voxel_mm), np.array(low_mm)
        self.at = low_mm[:, None, None, None] + voxel_mm[:, None, None, None] * np.indices(count)
        index_from_mm = np.diag([*(1 / voxel_mm), 1.0])
        index_from_mm[:3, 3] = -low_mm / voxel_mm
        self.tissue = SampledVolume(np.zeros((*count, 3)), index_from_mm, outside=0.0)
        organ = organ or SampledVolume(np.full((1, 1, 1), -1.0), np.diag([1e-6, 1e-6, 1e-6, 1.0]))
        self.plane = PlaneInTissue(embedding or Unmoved(), PIXELS)
        self.bmode = BMode(self.tissue, organ, self.plane, probe_of(), voxel_mm.min(), contact, 1.0)

    def fill(self, impedance=TISSUE, attenuation=0.0, backscatter=0.0) -> None:
        """Each a number or a function of x, y, z [mm]."""
        values = np.empty((*self.at[0].shape, 3), np.float32)
        for channel, given in enumerate((impedance, attenuation, backscatter)):
            values[..., channel] = given(*self.at) if callable(given) else given
        more = [(0, n) for n in np.subtract(self.tissue.count, self.tissue.shape)]
        fill((self.tissue.voxels, np.pad(values, [*more, (0, 0)], mode="edge").reshape(-1, 3)))

    def look(
        self, probe, detail_level="reflection", at=(0, 0, 0), along=(0, 1, 0), lateral=(1, 0, 0)
    ) -> np.ndarray:
        """Echoes (lines, samples) [dB] of a probe whose face is at a place and looks along a direction."""
        pose = pose_at(at, along, lateral, probe.housing_mm[2])
        self.plane.locate(image_plane(pose, probe.housing_mm[2], *probe.extent_mm))
        self.picture = self.bmode.render(probe, detail_level)
        return array_of(self.bmode.decibel).astype(float)


def flat_tank(voxel: float, **settings) -> Tank:
    """Fields of x and y alone: 100 mm wide, from 15 mm behind the probe's face to 90 mm before it."""
    count = (int(100 / voxel), int(105 / voxel), 1)
    return Tank((voxel, voxel, BOUNDLESS), count, (voxel / 2 - 50, -15.0, 0.0), **settings)


@pytest.fixture(scope="module", autouse=True)
def taichi():
    start("cpu")
    yield
    ti.reset()


@pytest.fixture(scope="module")
def fine(taichi) -> Tank:
    return flat_tank(0.5)


@pytest.fixture(scope="module")
def coarse(taichi) -> Tank:
    return flat_tank(0.9)


@pytest.fixture(scope="module")
def endless(taichi) -> Tank:
    return Tank((BOUNDLESS,) * 3, (1, 1, 1), (0.0, 0.0, 0.0))


def interface(before: float, behind: float, blur_mm: float, tilt_deg: float = 0.0, depth_mm: float = 40.0):
    """A plane step, its normal tilted from y towards x, blurred by a Gaussian."""
    tilt = np.radians(tilt_deg)

    def value(x, y, z):
        across = (y - depth_mm) * np.cos(tilt) + x * np.sin(tilt)
        return before + (behind - before) * special.ndtr(across / blur_mm)

    return value


def peaks(decibel: np.ndarray, probe: Probe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [mm], amplitude and SD [mm] of each line's highest echo: a Gaussian is a parabola in dB, three samples tell it."""
    i = np.clip(decibel.argmax(axis=1), 1, SAMPLES - 2)
    before, top, behind = (np.take_along_axis(decibel, i[:, None] + k, axis=1)[:, 0] for k in (-1, 0, 1))
    curve = before - 2 * top + behind
    off = (before - behind) / 2 / curve
    amplitude = 10 ** ((top - (before - behind) * off / 4) / 20)
    return (i + 0.5 + off) * probe.sample_mm, amplitude, probe.sample_mm * np.sqrt(-20 / np.log(10) / curve)


@pytest.mark.parametrize("detail_level", RUNGS)
@pytest.mark.parametrize("attenuation, frequency", [(0.18, 12.0), (0.5, 5.0), (1.0, 3.0)])
def test_the_echo_falls_with_depth_by_the_attenuation(fine, detail_level, attenuation, frequency):
    probe = probe_of(frequency_mhz=frequency)
    fine.fill(backscatter=0.1)
    lossless = fine.look(probe, detail_level)
    fine.fill(attenuation=attenuation, backscatter=0.1)
    lost = lossless - fine.look(probe, detail_level)
    wanted = 0.2 * attenuation * frequency * depths(probe)
    # Scatterers are the same, so every sample must fall alike, to 1 % of what 80 mm take: between two looks amplitude is a
    # chord of the exponential, 0.02 dB off, and 1e-9 is 0.1 % of speckle that is 40 dB down at -80 dB.
    assert np.abs(lost - wanted).max() < 0.01 * wanted[-1]
    slope = np.polyfit(depths(probe), lost.mean(axis=0), 1)[0]
    assert slope == pytest.approx(0.2 * attenuation * frequency, rel=1e-3)
    if detail_level == "reflection":
        assert np.abs(lossless + 20.0).max() < 1e-3


@pytest.mark.parametrize("tilt", [0, 20, 40, 60])
@pytest.mark.parametrize("size", ["fine", "coarse"])
def test_the_echo_of_an_interface_has_its_reflection_and_depth(request, size, tilt):
    tank, probe = request.getfixturevalue(size), probe_of()
    u, blur, cosine = probe.scanlines()[0][:, 0], 0.8 * tank.voxel_mm, np.cos(np.radians(tilt))
    lines = np.abs(u) < 8.0
    for depth in (39.7, 40.0, 40.3):
        tank.fill(interface(FAT, TISSUE, blur, tilt, depth))
        found, amplitude, width = (each[lines] for each in peaks(tank.look(probe), probe))
        # Looks that differ by less than 3e-4 are no part of it: of a Gaussian's flanks, where the next differs by less than
        # half as much, 6e-4 each of 0.08. Slopes of trilinear voxels point a few degrees off, which counts by tan(t) / 2.
        assert amplitude == pytest.approx(REFLECTION * np.sqrt(cosine), rel=0.05 if tilt else 0.015)
        # Impedance steps by more, relatively, where it is lower: a Gaussian's middle comes R SD / sqrt(pi) nearer, and a
        # voxel widens it by 1 / sqrt(6). One line is off by up to an SD of the pulse, square to the interface.
        nearer = REFLECTION * np.hypot(blur, tank.voxel_mm / np.sqrt(6)) / np.sqrt(np.pi) / cosine
        off = found - depth + u[lines] * np.tan(np.radians(tilt)) + nearer
        assert abs(off.mean()) < 0.02 and np.abs(off).max() < probe.axial_sd_mm / cosine
        assert width == pytest.approx(probe.axial_sd_mm, rel=1e-3)
        # Equal impedance reflects nothing.
        tank.fill(TISSUE, interface(0.1, 1.0, blur, tilt, depth))
        assert tank.look(probe).max() < SILENT_DB


@pytest.mark.parametrize("size", ["fine", "coarse"])
def test_an_interface_as_sharp_as_a_voxel_is_not_missed_between_samples(request, size):
    tank, probe = request.getfixturevalue(size), probe_of()
    tank.fill(lambda x, y, z: np.where(y < 40.0, FAT, TISSUE))
    true = tank.at[1][tank.at[1] < 40.0].max() + tank.voxel_mm / 2
    for ahead in (0.0, 0.1, 0.2, 0.3, 0.4):
        found, amplitude, _ = peaks(tank.look(probe, at=(0.0, ahead, 0.0)), probe)
        assert amplitude == pytest.approx(REFLECTION, rel=1e-3)
        # Half of the way from look to look.
        assert np.abs(found + ahead - true).max() < 0.25


@pytest.mark.parametrize("before, behind", [(0.5, 0.5), (0.5, 10.0), (1.0, 0.01)])
def test_the_echo_of_an_interface_is_attenuated_by_the_tissue_before_it(fine, before, behind):
    probe = probe_of()
    fine.fill(interface(FAT, TISSUE, 0.4), interface(before, behind, 0.4))
    found, amplitude, _ = peaks(fine.look(probe), probe)
    wanted = REFLECTION * 10 ** (-0.2 * before * probe.frequency_mhz * 40.0 / 20)
    # As at normal incidence above; and depth, to an SD of the pulse, counts by the round trip's loss.
    assert amplitude == pytest.approx(wanted, rel=0.015 + 0.2 * before * probe.frequency_mhz / 8.69 * 0.0872)
    assert np.abs(found - 40.0).max() < probe.axial_sd_mm


@pytest.mark.parametrize("within, more", [(FAT, 0.0), (GAS, 0.0), (STONE, 1.5)], ids=["fat", "gas", "stone"])
def test_behind_a_layer_is_the_shadow_of_its_faces_and_of_what_it_takes(fine, within, more):
    probe = probe_of()

    def share(y):
        """4 mm of it, with flanks of 1 mm."""
        return np.interp(y, [29.5, 30.5, 33.5, 34.5], [0, 1, 1, 0])

    fine.fill(lambda x, y, z: TISSUE + (within - TISSUE) * share(y), lambda x, y, z: more * share(y), 1.0)
    passed = 1 - ((within - TISSUE) / (within + TISSUE)) ** 2
    wanted = 2 * 20 * np.log10(passed) - 0.2 * more * probe.frequency_mhz * 4.0
    # A trapezoid over looks is off by 0.5^2 / 8 of a kink at most, at four; float32 holds gas's 1 - R^2 = 1e-3 to 1e-4, and
    # 1e-9 is 0.01 dB of what is left behind it.
    bound = 0.02 + 0.2 * more * probe.frequency_mhz * 4 * 0.5**2 / 8
    assert np.abs(fine.look(probe)[:, 320:] - wanted).max() < bound


def test_behind_a_cyst_the_echo_is_enhanced_by_the_missing_attenuation(fine):
    tissue, cyst, radius, probe = 0.7, 0.01, 6.0, probe_of()
    # With a rim of 1 mm, which looks 0.5 mm apart see.
    fine.fill(TISSUE, lambda x, y, z: cyst + (tissue - cyst) * np.clip(np.hypot(x, y - 30) - 5.5, 0, 1), 0.1)
    u = probe.scanlines()[0][:, 0]
    brighter = fine.look(probe)[:, 480] + 20.0 + 0.2 * tissue * probe.frequency_mhz * depths(probe)[480]
    wanted = 0.2 * (tissue - cyst) * probe.frequency_mhz * 2 * np.sqrt(np.maximum(radius**2 - u**2, 0))
    # The chord of a rim 1 mm wide is r^2 / 12 (r^2 - u^2)^1.5 < 0.04 mm off the circle's where |u| < 4 mm; trilinear voxels
    # and the trapezoid over looks by 0.5^2 / 8 each at a kink of two on either side.
    bound = 0.2 * tissue * probe.frequency_mhz * (0.04 + 4 * 2 * 0.5**2 / 8)
    assert np.abs(brighter - wanted)[np.abs(u) < 4.0].max() < bound
    assert np.abs(brighter)[np.abs(u) > radius + 1.0].max() < 0.01


def test_beyond_the_ct_nothing_reflects():
    tank = Tank((BOUNDLESS, 0.5, BOUNDLESS), (1, 40, 1), (0, 0.25, 0), contact="organ")
    tank.fill(backscatter=0.1)
    for beyond in (0.3, 2.0):
        decibel, y = tank.look(probe_of(), at=(0.0, -beyond, 0.0)), depths(probe_of()) - beyond
        # At the edges a look is half in, half out.
        assert np.abs(decibel[:, (y > 0.5) & (y < 19.5)] + 20.0).max() < 0.01
        assert decibel.max() < -19.99 and decibel[:, y > 20.5].max() < SILENT_DB


@pytest.mark.parametrize("focus_percent", [20.0, 40.0, 70.0])
@pytest.mark.parametrize("thin", [False, True])
def test_a_wire_is_drawn_as_wide_as_the_focus_makes_it(endless, focus_percent, thin):
    # Written into the lines, for no voxel is as thin. To the kernel all is as wide as the pulse before it, as speckle is and
    # a scatterer must be; a wire on one line alone comes out as much narrower than the point-spread function.
    probe = probe_of(transducer_width_mm=16.0, focus_depth_percent=focus_percent)
    endless.look(probe, "speckle")
    axial = 2 * 1.54 / 7.5 / 2 / FWHM
    u = probe.scanlines()[0][:, 0] - probe.scanlines()[0][LINES // 2, 0]
    profile = (u == 0).astype(float) if thin else np.exp(-0.5 * (u / axial) ** 2)
    fill((endless.bmode.real, np.repeat(profile[:, None], SAMPLES, axis=1)))
    endless.bmode.imaginary.fill(0.0)
    endless.bmode._spread()
    for depth in (8.0, 16.0, 32.0, 56.0, 72.0):
        line = array_of(endless.bmode.decibel)[:, int(depth / 0.125)].astype(float)
        near = line > line.max() - 6.0
        found = np.sqrt(-10 / np.log(10) / np.polyfit(u[near], line[near], 2)[0])
        formula = 1.54 / 7.5 * 3.0 / FWHM * np.sqrt(1 + ((depth - 0.8 * focus_percent) / 20.0) ** 2)
        # The kernel ends at 2.5 SD, and is that of a sample up to 0.06 mm away.
        assert found == pytest.approx(np.sqrt(formula**2 - thin * axial**2), rel=0.005)


@pytest.mark.parametrize("frequency, cycles", [(5.0, 2.0), (3.0, 3.0), (7.5, 4.0)])
def test_an_interface_has_the_pulses_length_and_the_same_amplitude_at_every_detail_level(
    fine, frequency, cycles
):
    probe = probe_of(frequency_mhz=frequency, pulse_cycles=cycles)
    fine.fill(interface(FAT, TISSUE, 0.4))
    for detail_level in RUNGS:
        # n cycles echo over n / 2 wavelengths: full width at half maximum.
        _, amplitude, width = peaks(fine.look(probe, detail_level), probe)
        assert width == pytest.approx(cycles * 1.54 / frequency / 2 / FWHM, rel=1e-3)
        assert amplitude == pytest.approx(REFLECTION, rel=0.015)


@pytest.mark.parametrize("detail_level", RUNGS[1:])
def test_speckle_is_rayleigh(endless, detail_level):
    probe = probe_of()
    endless.fill(backscatter=0.1)
    # Four SD apart intensities correlate by exp(-8).
    along = int(4 * probe.axial_sd_mm / 0.125) + 1
    across = int(4 * probe.lateral_sd_mm(depths(probe)).max() / (40.0 / LINES)) + 1
    amplitude = 10 ** (endless.look(probe, detail_level, (3.0, 7.0, 0.4))[::across, ::along].ravel() / 20)
    assert len(amplitude) > 2000
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
    # What the kernel adds up lies 1.4 entries apart in the mean where lines are dense: noise ends at the borders of blocks of
    # 64, which takes 3 % of it there, and, held over entries, is 5 % short aslant to them. Sampling has an SD of 1 to 3 %.
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
    # Scatterers of no correlation, through a Gaussian of SD s, give an echo's of exp(-d^2 / 4 s^2), an intensity's squared.
    # Noise held over an entry correlates by chords of that, 0.04 off; 3000 cells of its block leave an SD of 0.02.
    for axis, first, last in ((2, 0, SAMPLES), (1, 40, 160), (1, 200, 310), (1, 500, 620)):
        field = np.moveaxis(intensity[..., first:last], axis, 0)
        width = probe.lateral_sd_mm(depths(probe)[first:last]) if axis == 1 else probe.axial_sd_mm
        step = 40.0 / LINES if axis == 1 else probe.sample_mm
        for lag in range(1, 7):
            correlation = (field[lag:] * field[:-lag]).mean() / (field**2).mean()
            assert correlation == pytest.approx(np.exp(-0.5 * (lag * step / width) ** 2).mean(), abs=0.06)


@pytest.mark.parametrize("detail_level", RUNGS)
def test_the_same_pose_gives_the_same_bits_again(fine, detail_level):
    probe = probe_of()
    fine.fill(interface(FAT, TISSUE, 0.4, 20.0), 0.5, 0.1)
    first, picture = fine.look(probe, detail_level), fine.picture
    assert (fine.look(probe, detail_level) == first).all()
    assert np.abs(fine.look(probe_of(frequency_mhz=5.0), detail_level, (2.0, 1.0, 3.0)) - first).max() > 1.0
    assert (fine.look(probe, detail_level) == first).all() and (fine.picture == picture).all()


@pytest.fixture(scope="module")
def moved(taichi):
    """A tank whose tissue a ball of 12 mm carries along, and what moves it: x -> matrix @ x + shift."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=12.0)
    model = tissue_of(ball)
    embedding = Embedding(model, ball, 4.0)

    def move(matrix, shift) -> None:
        x = (model.body.rest_points @ np.transpose(matrix) + shift).astype(np.float32)
        model.body.restore(BodyState(x, np.zeros_like(x)))
        model.update_frames()
        embedding.update()

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
    # Places are right to 1e-5 mm, noise is held over 0.06 mm: 5 in 10^4 samples take another entry, and ten lines see each.
    assert (np.abs(again - first)[np.hypot(u, v) < 10.5] < 0.01).mean() > 0.99
    assert np.abs(tank.look(probe, "speckle", face) - first).mean() > 3.0


@pytest.mark.parametrize("across, along, shear", [(0.01, -0.02, 0.0), (0.0, -0.03, 0.0), (0.0, -0.01, 0.02)])
def test_tracked_speckle_moves_as_the_tissue_does(moved, across, along, shear):
    (tank, move), probe = moved, probe_of(**SMALL)
    tank.fill(attenuation=0.5, backscatter=0.1)
    strain, shift = np.array([[across, shear, 0], [0, along, 0], [0, 0, 0]]), np.array([-0.3, 0.4, 0.0])
    frames = []
    for share in (0, 1):
        move(np.eye(3) + share * strain, share * shift)
        frames.append(10 ** (tank.look(probe, "speckle", (0.0, -10.0, 0.4)) / 20))
    size = np.array([16.0 / LINES, 20.0 / SAMPLES])
    half, found, wanted = (18, 48), [], []
    for place in np.mgrid[-6:6.1:1.5, -6:6.1:1.5].reshape(2, -1).T:
        at = np.rint((place + [8, 10]) / size - 0.5).astype(int)
        block = tuple(slice(i - h, i + h + 1) for i, h in zip(at, half, strict=True))
        blocks = [frame[block] - frame[block].mean() for frame in frames]
        found.append(-phase_cross_correlation(*blocks, upsample_factor=20, normalization=None)[0] * size)
        wanted.append(strain[:2, :2] @ ((at + 0.5) * size - [8, 10]) + shift[:2])
    errors, ways = (np.linalg.norm(each, axis=1) for each in (np.subtract(found, wanted), wanted))
    # The skin follows an affine map to strain times the way to a cluster's centre, 2 % of 2 mm; the search steps by 0.004 mm.
    assert errors.mean() < 0.05 and errors.max() < 0.2 < ways.mean()


def test_a_target_off_the_plane_is_dimmed_as_the_thick_plane_weighs_it():
    probe, thickness = probe_of(elevation_width_mm=4.0), 4.0 / FWHM
    tank = Tank((BOUNDLESS, BOUNDLESS, 0.05), (1, 1, 321), (0, 0, -8.0))
    assert probe.elevation_sd_mm == pytest.approx(thickness)
    tank.fill(backscatter=0.1)
    uniform = tank.look(probe, "elevation")
    for off in (0.0, 0.6, 1.0, 1.2, 2.0):

        def target(z):
            return 1e-4 + 0.5 * np.exp(-0.5 * ((z / thickness - off) / 0.5) ** 2)

        # Planes at 0 and 1.2 SD to either side, with weights as 1 to 1/2: exp(-1.2^2 / 2) is 0.49.
        weighed = (target(0.0) + target(-1.2 * thickness) / 2 + target(1.2 * thickness) / 2) / 2
        # The same scatterers, so sample by sample; a voxel's chord of the Gaussian is 0.1 % off in its flank.
        tank.fill(backscatter=lambda x, y, z: target(z))
        assert np.abs(tank.look(probe, "elevation") - uniform - 20 * np.log10(weighed / 0.1)).max() < 0.02
        tank.fill(attenuation=lambda x, y, z: target(z), backscatter=0.1)
        lost = 0.2 * weighed * probe.frequency_mhz * depths(probe)
        assert np.abs(uniform - tank.look(probe, "elevation") - lost).max() < 0.01 * lost[-1] + 0.01
