"""The echo against closed forms: what tissue takes, reflects and scatters, how wide a point is drawn, and where."""

import numpy as np
import pytest
import taichi as ti
import trimesh
from conftest import rotation_about
from particle_tissue import tissue_of
from scipy import ndimage, special, stats
from scipy.spatial.transform import Rotation
from skimage.feature import match_template

from sim.body import BodyState
from sim.device import start
from sim.embedding import Embedding, Unmoved
from ultrasound.array import Probe
from ultrasound.bmode import BMode
from ultrasound.plane import PlaneInTissue
from ultrasound.point_spread import axial_sd_mm, elevation_sd_mm, lateral_sd_mm
from ultrasound.probe import advanced, image_plane, pose_at
from ultrasound.speckle import PITCHES, SIZE
from ultrasound.volume import Volume, distance_volume

LINES, SAMPLES, PIXELS = 192, 640, 256
TISSUE_Z, FAT_Z, GAS_Z, STONE_Z = 1.62, 1.38, 4e-4, 6.0
# The least that a picture's float32 logarithms show: 20 log10(1e-9).
SILENT_DB = -179.9
# A linear array of 0.125 mm a sample; no gain, so that 0 dB is all of the sound.
PLAIN = {
    "transducer_name": "test",
    "housing_mm": (40.0, 10.0, 20.0),
    "number_of_scanlines": LINES,
    "number_of_samples_per_scanline": SAMPLES,
    "depth_mm": 80.0,
    "frequency_mhz": 7.5,
    "f_number": 3.0,
    "focal_zone_mm": 20.0,
    "gain_percent": 50.0,
    "dyn_range_db": 60.0,
    "depth_compensation_db_cm_mhz": 0.0,
}
SECTORS = {
    "LINEAR": {},
    "CURVILINEAR": {"radius_start_mm": 60.0, "theta_start_deg": -25.0, "theta_stop_deg": 20.0},
    "PHASED": {"transducer_width_mm": 20.0, "theta_start_deg": -40.0, "theta_stop_deg": 40.0},
}


def probe_of(geometry: str = "LINEAR", **settings) -> Probe:
    return Probe(**{**PLAIN, "transducer_geometry": geometry, **SECTORS[geometry], **settings})


def sample_depths(probe: Probe) -> np.ndarray:
    return (np.arange(SAMPLES) + 0.5) * probe.sample_mm


class Tank:
    """Tissue that a probe looks into along y, filled anew for each test: so kernels are compiled but once.

    ``voxel_mm`` and ``count`` are of the axes, ``low_mm`` is the first voxel's centre; one voxel is as good as no end.
    """

    def __init__(self, voxel_mm, count, low_mm, embedding=None, organ=None, contact="tissue") -> None:
        self.voxel_mm = voxel_mm[1]
        self.at = np.meshgrid(
            *(low + size * np.arange(n) for low, size, n in zip(low_mm, voxel_mm, count)), indexing="ij"
        )
        index_from_mm = np.diag([*(1 / np.array(voxel_mm)), 1.0])
        index_from_mm[:3, 3] = -np.array(low_mm) / voxel_mm
        self.tissue = Volume(np.zeros((*count, 3)), index_from_mm, outside=0.0)
        nowhere = Volume(np.full((1, 1, 1), -1.0), np.diag([1e-6, 1e-6, 1e-6, 1.0]), outside=1e6)
        self.plane = PlaneInTissue(embedding or Unmoved(), PIXELS)
        self.bmode = BMode(self.tissue, organ or nowhere, self.plane, probe_of(), min(voxel_mm), contact)

    def fill(self, impedance=TISSUE_Z, attenuation=0.0, backscatter=0.0) -> None:
        """Each a number or a function of x, y, z [mm]."""
        values = np.empty((*self.at[0].shape, 3), np.float32)
        for channel, given in enumerate((impedance, attenuation, backscatter)):
            values[..., channel] = given(*self.at) if callable(given) else given
        thin = [(0, more - n) for n, more in zip(self.tissue.shape, self.tissue.count)]
        self.tissue.voxels.from_numpy(np.pad(values, [*thin, (0, 0)], mode="edge").reshape(-1, 3))

    def look(
        self, probe, rung="reflection", at=(0, 0, 0), towards=(0, 1, 0), lateral=(1, 0, 0)
    ) -> np.ndarray:
        """Echoes (lines, samples) [dB]."""
        return self.see(probe, rung, pose_at(at, towards, lateral, probe.housing_mm[2]))

    def see(self, probe: Probe, rung: str, pose: np.ndarray) -> np.ndarray:
        self.plane.take(image_plane(pose, probe.housing_mm[2], *probe.extent_mm))
        self.picture = self.bmode.render(probe, rung)
        return self.bmode.decibel.to_numpy().astype(float)


def flat_tank(voxel_mm: float, **settings) -> Tank:
    """Fields of x and y alone: 100 mm wide, from 15 mm behind the probe's face to 90 mm before it."""
    size = (voxel_mm, voxel_mm, 1e4)
    return Tank(
        size, (int(100 / voxel_mm), int(105 / voxel_mm), 1), (voxel_mm / 2 - 50, -15.0, 0.0), **settings
    )


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
    return Tank((1e4, 1e4, 1e4), (1, 1, 1), (0.0, 0.0, 0.0))


def step_across(tilt_deg: float, before, behind, depth_mm: float = 40.0, blur_mm: float = 0.72):
    """A plane interface at a depth, its normal tilted from y towards x, blurred as ``acoustics`` blurs labels."""
    tilt = np.radians(tilt_deg)

    def value(x, y, _):
        across = (y - depth_mm) * np.cos(tilt) + x * np.sin(tilt)
        return before + (behind - before) * special.ndtr(across / blur_mm)

    return value


def layer(before, within, top_mm: float, thickness_mm: float, ramp_mm: float):
    """A level layer with linear flanks whose integral over depth is its thickness."""

    def value(x, y, _):
        share = np.interp(
            y, np.cumsum([top_mm - ramp_mm / 2, ramp_mm, thickness_mm - ramp_mm, ramp_mm]), [0, 1, 1, 0]
        )
        return before + (within - before) * share

    return value


def peaks(decibel: np.ndarray, probe: Probe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [mm], amplitude and SD [mm] of each line's highest echo: a Gaussian is a parabola in dB, three samples tell it."""
    i = np.clip(decibel.argmax(axis=1), 1, SAMPLES - 2)
    before, top, behind = (np.take_along_axis(decibel, i[:, None] + k, axis=1)[:, 0] for k in (-1, 0, 1))
    curve = before - 2 * top + behind
    off = (before - behind) / 2 / curve
    amplitude = 10 ** ((top - (before - behind) * off / 4) / 20)
    return (i + 0.5 + off) * probe.sample_mm, amplitude, probe.sample_mm * np.sqrt(-20 / np.log(10) / curve)


@pytest.mark.parametrize("rung", ["reflection", "speckle", "elevation"])
@pytest.mark.parametrize("attenuation, frequency", [(0.18, 12.0), (0.5, 5.0), (1.0, 3.0)])
def test_echo_falls_with_depth_by_what_tissue_takes(fine, rung, attenuation, frequency):
    probe = probe_of(frequency_mhz=frequency)
    fine.fill(backscatter=0.1)
    lossless = fine.look(probe, rung)
    fine.fill(attenuation=attenuation, backscatter=0.1)
    lossy = fine.look(probe, rung)
    wanted = 2 * attenuation * frequency * sample_depths(probe) / 10
    # Scatterers are the same, so every sample must fall alike: within 1 % of what 80 mm take. Between two looks, 0.5 mm
    # apart, the amplitude is a chord of the exponential, 0.02 dB off; 1e-9 is 0.1 % of speckle 40 dB down at -140 dB.
    assert np.abs(lossless - lossy - wanted).max() < 0.01 * wanted[-1]
    slope = np.polyfit(sample_depths(probe), (lossless - lossy).mean(axis=0), 1)[0]
    assert slope == pytest.approx(0.2 * attenuation * frequency, rel=1e-3)
    if rung == "reflection":
        assert np.abs(lossless + 20.0).max() < 1e-3


@pytest.mark.parametrize("tilt", [0, 20, 40, 60])
def test_equal_impedance_reflects_nothing_at_any_angle(fine, coarse, tilt):
    for tank in (fine, coarse):
        tank.fill(TISSUE_Z, step_across(tilt, 0.1, 1.0), 0.0)
        assert tank.look(probe_of()).max() < SILENT_DB


@pytest.mark.parametrize("tilt", [0, 20, 40, 60])
@pytest.mark.parametrize("size", ["fine", "coarse"])
def test_an_interface_echoes_what_it_reflects_from_where_it_is(request, size, tilt):
    tank, probe = request.getfixturevalue(size), probe_of()
    reflection = (TISSUE_Z - FAT_Z) / (TISSUE_Z + FAT_Z)
    u = probe.scanlines()[0][:, 0]
    lines = np.abs(u) < 8.0
    for depth in (39.7, 40.0, 40.3):
        tank.fill(step_across(tilt, FAT_Z, TISSUE_Z, depth, 0.8 * tank.voxel_mm))
        found, amplitude, width = (each[lines] for each in peaks(tank.look(probe), probe))
        # Looks that differ by less than 3e-4 are no part of it: of a Gaussian flank, which falls faster than by half a look,
        # at most 6e-4 at each end of 0.08. Slopes of trilinear voxels point a few degrees off, which counts by tan(t) / 2.
        wanted = reflection * np.sqrt(np.cos(np.radians(tilt)))
        assert amplitude == pytest.approx(wanted, rel=0.015 if tilt == 0 else 0.05)
        # Within an SD of the pulse, square to the interface; an SD that three samples show but for float32's logarithm.
        true = depth - u[lines] * np.tan(np.radians(tilt))
        assert np.abs(found - true).max() < axial_sd_mm(probe) / np.cos(np.radians(tilt))
        assert width == pytest.approx(axial_sd_mm(probe), rel=1e-3)


@pytest.mark.parametrize("size", ["fine", "coarse"])
def test_an_interface_as_sharp_as_voxels_can_be_is_not_lost_between_looks(request, size):
    tank, probe = request.getfixturevalue(size), probe_of()
    tank.fill(lambda x, y, z: np.where(y < 40.0, FAT_Z, TISSUE_Z))
    true = tank.at[1][tank.at[1] < 40.0].max() + tank.voxel_mm / 2
    for ahead in (0.0, 0.1, 0.2, 0.3, 0.4):
        found, amplitude, _ = peaks(tank.look(probe, at=(0.0, ahead, 0.0)), probe)
        assert amplitude == pytest.approx((TISSUE_Z - FAT_Z) / (TISSUE_Z + FAT_Z), rel=1e-3)
        # Looks are 0.5 mm apart.
        assert np.abs(found + ahead - true).max() < 0.25


@pytest.mark.parametrize(
    "within, more", [(FAT_Z, 0.0), (GAS_Z, 0.0), (STONE_Z, 1.5)], ids=["fat", "gas", "stone"]
)
def test_behind_a_layer_is_the_shadow_of_its_faces_and_of_what_it_takes(fine, within, more):
    thickness, ramp, probe = 4.0, 1.0, probe_of()
    fine.fill(
        layer(TISSUE_Z, within, 30.0, thickness, ramp), layer(0.02, 0.02 + more, 30.0, thickness, ramp), 1.0
    )
    behind = fine.look(probe)[:, 320:]
    passed = 1 - ((within - TISSUE_Z) / (within + TISSUE_Z)) ** 2
    lost = 2 * probe.frequency_mhz / 10 * (0.02 * sample_depths(probe)[320:] + more * thickness)
    # A trapezoid over looks 0.5 mm apart is off by at most 0.5^2 / 8 of the kink in slope, at four kinks; float32 holds
    # 1 - R^2 of gas, 1e-3, to 1e-4, and 1e-9 is 0.01 dB of what is left behind it.
    bound = 0.02 + 4 * 0.5**2 / 8 / ramp * more * 2 * probe.frequency_mhz / 10
    assert np.abs(behind + lost - 2 * 20 * np.log10(passed)).max() < bound


def test_behind_a_cyst_the_echo_is_brighter_by_what_it_does_not_take(fine):
    tissue, cyst, radius, probe = 0.7, 0.01, 6.0, probe_of()
    # A rim of 1 mm, so that looks 0.5 mm apart see it.
    fine.fill(
        TISSUE_Z,
        lambda x, y, z: cyst + (tissue - cyst) * np.clip(np.hypot(x, y - 30) - radius + 0.5, 0, 1),
        0.1,
    )
    decibel = fine.look(probe)
    chord = 2 * np.sqrt(np.maximum(radius**2 - probe.scanlines()[0][:, 0] ** 2, 0))
    brighter = decibel + 20.0 + 0.2 * tissue * probe.frequency_mhz * sample_depths(probe)
    wanted = 0.2 * (tissue - cyst) * probe.frequency_mhz * chord
    across, beside = (
        chord > 2 * np.sqrt(radius**2 - 4.0**2),
        np.abs(probe.scanlines()[0][:, 0]) > radius + 1.0,
    )
    # Over |u| < 4 mm the chord of a rim of width w differs from the circle's by w^2 / 12 r^2 / (r^2 - u^2)^1.5 < 0.04 mm,
    # that of trilinear voxels by 0.5^2 / 8 as much again, and the trapezoid at four kinks by 0.5^2 / 8 each.
    assert np.abs(brighter[across, 480] - wanted[across]).max() < 0.2 * tissue * probe.frequency_mhz * 0.2
    assert np.abs(brighter[beside]).max() < 0.01


@pytest.mark.parametrize("beyond_mm", [0.3, 2.0])
def test_beyond_the_ct_nothing_reflects(beyond_mm):
    probe, thin = (
        probe_of(depth_mm=40.0),
        Tank((1e4, 0.5, 1e4), (1, 40, 1), (0.0, 0.25, 0.0), contact="organ"),
    )
    thin.fill(backscatter=0.1)
    decibel = thin.look(probe, at=(0.0, -beyond_mm, 0.0))
    depth = sample_depths(probe) - beyond_mm
    # A look is 0.5 mm long: half in, half out at the edges.
    assert np.abs(decibel[:, (depth > 0.5) & (depth < 19.5)] + 20.0).max() < 0.01
    assert decibel[:, depth > 20.5].max() < SILENT_DB


@pytest.mark.parametrize("focus_percent", [20.0, 40.0, 70.0])
@pytest.mark.parametrize("wire", ["as a scatterer", "of no width"])
def test_a_wire_is_drawn_as_wide_as_the_focus_makes_it(endless, focus_percent, wire):
    # Written into the lines: no voxel is as thin. The kernel takes lines to be as wide as the pulse already, as noise is, and
    # a scatterer with it; so that of no width at all comes out as much narrower than the point-spread function.
    probe = probe_of(transducer_width_mm=16.0, focus_depth_percent=focus_percent)
    endless.fill()
    endless.look(probe, "speckle")
    u, axial = probe.scanlines()[0][:, 0], axial_sd_mm(probe)
    middle = u[LINES // 2]
    own = axial if wire == "as a scatterer" else 0.0
    profile = np.exp(-0.5 * ((u - middle) / axial) ** 2) if own else (u == middle).astype(float)
    endless.bmode.real.from_numpy(np.repeat(profile[:, None], SAMPLES, axis=1).astype(np.float32))
    endless.bmode.imaginary.fill(0.0)
    endless.bmode._spread()
    decibel = endless.bmode.decibel.to_numpy().astype(float)
    at_focus = probe.wavelength_mm * 3.0 / np.sqrt(8 * np.log(2))
    for depth in (8.0, 16.0, 32.0, 56.0, 72.0):
        line = decibel[:, int(depth / probe.sample_mm)]
        near = line > line.max() - 6.0
        found = np.sqrt(-10 / np.log(10) / np.polyfit(u[near], line[near], 2)[0])
        formula = at_focus * np.sqrt(1 + ((depth - 0.8 * focus_percent) / 20.0) ** 2)
        # The kernel ends at 2.5 SD, where it is 4 % of its height, and is that of the depth's sample, 0.06 mm off at most.
        assert found == pytest.approx(np.sqrt(formula**2 - axial**2 + own**2), rel=0.01)


@pytest.mark.parametrize("frequency, cycles", [(5.0, 2.0), (3.0, 3.0), (7.5, 4.0)])
def test_an_interface_is_as_long_as_the_pulse(fine, frequency, cycles):
    probe = probe_of(frequency_mhz=frequency, pulse_cycles=cycles)
    fine.fill(step_across(0.0, FAT_Z, TISSUE_Z))
    for rung in ("reflection", "speckle", "elevation"):
        # n cycles take n wavelengths there and back: full width at half maximum of n / 2 wavelengths.
        wanted = cycles * 1.54 / frequency / 2 / np.sqrt(8 * np.log(2))
        assert peaks(fine.look(probe, rung), probe)[2] == pytest.approx(wanted, rel=1e-3)


@pytest.mark.parametrize("rung", ["speckle", "elevation"])
def test_speckle_is_rayleigh(endless, rung):
    probe = probe_of()
    endless.fill(backscatter=0.1)
    decibel = endless.look(probe, rung, at=(3.0, 7.0, 0.4))
    # Four SD apart intensities correlate by exp(-8).
    along = int(np.ceil(4 * axial_sd_mm(probe) / probe.sample_mm))
    across = int(
        np.ceil(4 * lateral_sd_mm(probe, sample_depths(probe)).max() / probe.line_spacing_mm(np.zeros(1))[0])
    )
    amplitude = 10 ** (decibel[::across, ::along].ravel() / 20)
    assert len(amplitude) > 2000
    scale = np.sqrt((amplitude**2).mean() / 2)
    assert stats.kstest(amplitude, stats.rayleigh(scale=scale).cdf).pvalue > 0.01


@pytest.mark.parametrize("geometry", list(SECTORS))
@pytest.mark.parametrize("rung", ["speckle", "elevation"])
def test_the_mean_square_of_speckle_is_the_backscatter_squared(endless, geometry, rung):
    probe, at = probe_of(geometry), np.random.default_rng(4)
    endless.fill(backscatter=0.1)
    squares = []
    for turn in Rotation.random(12, random_state=5).as_matrix():
        decibel = endless.look(probe, rung, at.uniform(-50, 50, 3), turn[0], turn[1])
        squares.append((10 ** (decibel / 10)).mean(axis=0) / 0.1**2)
    # Noise ends at the borders of its block, 64 entries apart: neighbours 1.4 entries apart, the mean over the kernel, do not
    # add up across it, which takes 4 % at most. 12 pictures of some 2000 cells each (the block has 3000) leave 1 %.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.05)
    assert np.mean(squares, axis=0).reshape(8, -1).mean(axis=1) == pytest.approx(np.ones(8), abs=0.08)


def test_speckle_correlates_as_the_point_spread_function_does(endless):
    probe = probe_of(depth_mm=40.0)
    endless.fill(backscatter=0.1)
    places = np.random.default_rng(6).uniform(-50, 50, (8, 3))
    intensity = np.stack([10 ** (endless.look(probe, "speckle", at) / 10) / 0.1**2 - 1 for at in places])

    def correlation(axis: int, lag: int, part: slice) -> float:
        field = np.moveaxis(intensity[..., part], axis, 0)
        return float((field[lag:] * field[:-lag]).mean() / (field**2).mean())

    # Scatterers of no correlation through a Gaussian of SD s: the echo's by exp(-d^2 / 4 s^2), the intensity's by its square.
    # Noise held over an entry correlates by chords of that, 0.04 off; 3000 cells of the block have an SD of 0.02.
    assert (SIZE / (2 * np.sqrt(np.pi) * PITCHES)) ** 3 > 3000
    for lag in range(1, 6):
        wanted = np.exp(-0.5 * (lag * probe.sample_mm / axial_sd_mm(probe)) ** 2)
        assert correlation(2, lag, slice(None)) == pytest.approx(wanted, abs=0.06)
    spacing = 40.0 / LINES
    for part in (slice(40, 160), slice(200, 310), slice(500, 620)):
        width = lateral_sd_mm(probe, sample_depths(probe)[part])
        for lag in range(1, 7):
            wanted = np.exp(-0.5 * (lag * spacing / width) ** 2).mean()
            assert correlation(1, lag, part) == pytest.approx(wanted, abs=0.06)


@pytest.mark.parametrize("rung", ["reflection", "speckle", "elevation"])
def test_a_still_probe_shows_the_same_bits_also_after_it_was_away(fine, rung):
    probe = probe_of()
    fine.fill(step_across(20.0, FAT_Z, TISSUE_Z), 0.5, 0.1)
    first, picture = fine.look(probe, rung), fine.picture
    again = fine.look(probe, rung)
    away = fine.look(probe_of(frequency_mhz=5.0), rung, at=(2.0, 1.0, 3.0))
    back = fine.look(probe, rung)
    assert np.abs(away - first).max() > 1.0
    assert (again == first).all() and (back == first).all() and (fine.picture == picture).all()


@pytest.fixture(scope="module")
def moved(taichi):
    """A tank whose tissue a ball of 12 mm carries along, and what moves it: x -> matrix @ x + shift."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=12.0)
    model = tissue_of(ball)
    embedding = Embedding(model, ball, 4.0)

    def move(matrix: np.ndarray, shift: np.ndarray) -> None:
        x = (model.body.rest_points @ matrix.T + shift).astype(np.float32)
        model.body.restore(BodyState(x, np.zeros_like(x)))
        model.update_frames()
        embedding.update()

    return flat_tank(0.5, embedding=embedding), move


# So that a ball fills the picture, in cells small enough for tracking.
SMALL = {"transducer_width_mm": 16.0, "depth_mm": 20.0, "frequency_mhz": 9.0, "focus_depth_percent": 45.0}


# Where the body's own frame begins, its blocks of noise do: there rounding must not choose between two of them.
@pytest.mark.parametrize("elevation", [0.0, 0.4])
def test_tissue_and_probe_moved_alike_give_the_same_picture(moved, elevation):
    (tank, move), probe = moved, probe_of(**SMALL)
    tank.fill(step_across(25.0, FAT_Z, TISSUE_Z, 1.0), 0.5, 0.1)
    turn, shift, face = (
        rotation_about([1, 2, -1], 25),
        np.array([1.3, -2.1, 0.7]),
        np.array([0.0, -10.0, elevation]),
    )
    move(np.eye(3), 0 * shift)
    first = tank.look(probe, "speckle", face)
    move(turn, shift)
    again = tank.look(probe, "speckle", turn @ face + shift, turn @ [0, 1, 0], turn @ [1, 0, 0])
    # Within the ball: the corners are of tetrahedra around it. Places at rest are right to 1e-5 mm and noise is held over
    # 0.06 mm: three in 10^4 fall into the next entry on one of three axes, and each of these is seen by some ten lines.
    u, v = np.meshgrid(probe.scanlines()[0][:, 0], sample_depths(probe) - 10.0, indexing="ij")
    assert (np.abs(again - first)[np.hypot(u, v) < 10.5] < 0.01).mean() > 0.99
    still = tank.look(probe, "speckle", face)
    assert np.abs(still - first).mean() > 3.0


@pytest.mark.parametrize(
    "strain, shift",
    [
        ([[0.01, 0.0], [0.0, -0.02]], [0.2, 0.4]),
        ([[0, 0], [0, -0.03]], [-0.3, 0.3]),
        ([[0, 0.02], [0, -0.01]], [0.0, -0.5]),
    ],
)
def test_tracked_speckle_moves_as_the_tissue_does(moved, strain, shift):
    (tank, move), probe = moved, probe_of(**SMALL)
    tank.fill(attenuation=0.5, backscatter=0.1)
    frames = []
    for matrix, offset in ((np.eye(3), np.zeros(3)), (np.eye(3), np.append(shift, 0.0))):
        if offset.any():
            matrix[:2, :2] += strain
        move(matrix, offset)
        frames.append(10 ** (tank.look(probe, "speckle", (0.0, -10.0, 0.4)) / 20))
    size = np.array([16.0 / LINES, 20.0 / SAMPLES])
    half, reach = np.rint(1.25 / size).astype(int), np.rint(1.0 / size).astype(int)
    errors, moves = [], []
    for place in np.mgrid[-5.5:6:1.5, -6:7:1.5].reshape(2, -1).T:
        if np.hypot(*place) < 7.5:
            i = np.rint((place - [-8.0, -10.0]) / size - 0.5).astype(int)
            block, around = (
                frame[tuple(slice(k - w, k + w + 1) for k, w in zip(i, way))]
                for frame, way in zip(frames, (half, half + reach))
            )
            likeness = match_template(around, block)
            best = np.array(np.unravel_index(likeness[1:-1, 1:-1].argmax(), likeness[1:-1, 1:-1].shape)) + 1
            before, behind = (
                np.array([likeness[best[0] + k, best[1]], likeness[best[0], best[1] + k]]) for k in (-1, 1)
            )
            best = best + (before - behind) / 2 / (before - 2 * likeness[tuple(best)] + behind)
            moves.append(np.array(strain) @ ((i + 0.5) * size - [8.0, 10.0]) + shift)
            errors.append(np.hypot(*((best - reach) * size - moves[-1])))
    assert len(errors) > 40 and np.hypot(*np.transpose(moves)).mean() > 0.4
    assert np.mean(errors) < 0.05 and np.max(errors) < 0.2


@pytest.fixture(scope="module")
def gated(taichi) -> Tank:
    """Sound enters where the organ, which is all that lies below y = 0, is within a millimetre."""
    organ = trimesh.creation.box([70.0, 60.0, 30.0])
    organ.apply_translation([0.0, 30.0, 0.0])
    tank = flat_tank(0.5, organ=distance_volume(organ, 1.0), contact="organ")
    tank.fill(backscatter=0.1)
    return tank


def test_a_lifted_probe_is_dark_and_sees_again_when_pressed(gated):
    probe = probe_of()
    for height, dark in ((-2.0, False), (0.9, False), (1.1, True), (10.0, True)):
        decibel = gated.look(probe, at=(0.0, -height, 0.0))
        assert (decibel < SILENT_DB).all() if dark else np.abs(decibel + 20.0).max() < 1e-3
        assert (gated.picture == 0).all() if dark else gated.picture.min() > 0


def test_of_a_tilted_probe_the_elements_that_touch_are_heard(gated):
    probe, tilt = probe_of(), np.radians(6.0)
    pose = pose_at((0.0, -1.0, 0.0), (np.sin(tilt), np.cos(tilt), 0.0), (1.0, 0.0, 0.0), 20.0)
    decibel = gated.see(probe, "reflection", pose)
    touching = probe.scanlines()[0][:, 0] < 0
    # To 1.2 mm of depth a line's aperture is its own element: half as wide as depth / f-number, in elements of 0.21 mm.
    for lines, level in ((touching, -20.0), (~touching, -180.0)):
        assert np.abs(decibel[lines, :8] - level).max() < 0.1
    # Deep down the lines at the edge have half of an aperture of 2 h + 1 elements.
    half = int(75.0 / 2 / probe.f_number / (40.0 / LINES))
    wanted = 20 * np.log10(0.1 * np.array([half + 1, half]) / (2 * half + 1))
    assert decibel[LINES // 2 - 1 : LINES // 2 + 1, 600] == pytest.approx(wanted, abs=0.02)
    pressed = gated.see(probe, "reflection", advanced(pose, 2.5))
    assert np.abs(pressed + 20.0).max() < 1e-3


def pixel_places(geometry: str) -> tuple[np.ndarray, np.ndarray]:
    """u, v [mm] of the pixels' centres of a picture 80 mm deep."""
    radius, reach_deg = {"LINEAR": (0.0, 0.0), "CURVILINEAR": (60.0, 25.0), "PHASED": (0.0, 40.0)}[geometry]
    width = 40.0 if geometry == "LINEAR" else 2 * (radius + 80.0) * np.sin(np.radians(reach_deg))
    above = radius * (1 - np.cos(np.radians(reach_deg)))
    at = (np.arange(PIXELS) + 0.5) / PIXELS
    return np.meshgrid((at - 0.5) * width, at * (80.0 + above) - above)


@pytest.mark.parametrize("geometry", list(SECTORS))
def test_the_picture_is_the_lines_bilinearly_and_black_beyond_them(endless, geometry):
    probe, (u, v) = probe_of(geometry), pixel_places(geometry)
    endless.fill(backscatter=0.1)
    decibel = endless.look(probe, "speckle")
    line, depth = (u / 40.0 + 0.5) * LINES - 0.5, v
    if geometry != "LINEAR":
        start, stop = np.radians([probe.theta_start_deg, probe.theta_stop_deg])
        angle, depth = np.arctan2(u, v + probe.radius_mm), np.hypot(u, v + probe.radius_mm) - probe.radius_mm
        line = (angle - start) / (stop - start) * LINES - 0.5
    # How far within the sector, in lines or samples; float32 may round what lies on its edge either way.
    within = np.minimum.reduce([line + 0.5, LINES - 0.5 - line, depth / 0.125, (80.0 - depth) / 0.125])
    assert (endless.picture[within < -1e-3] == 0).all()
    assert (within < -1e-3).any() == (geometry != "LINEAR")
    mixed = ndimage.map_coordinates(decibel, [line, depth / 0.125 - 0.5], order=1, mode="nearest")
    wanted = 255 * np.clip(mixed / probe.dyn_range_db + 1, 0, 1)
    # Rounding, and float32 fractions of a sample next to a null of 100 dB.
    assert np.abs(endless.picture - wanted)[within > 1e-3].max() < 1.0


@pytest.mark.parametrize("geometry", list(SECTORS))
@pytest.mark.parametrize("target", [(-13.3, 22.1), (12.2, 55.7)])
def test_a_target_is_drawn_where_it_is(fine, geometry, target):
    fine.fill(
        TISSUE_Z, 0.0, lambda x, y, z: 0.5 * np.exp(-((x - target[0]) ** 2 + (y - target[1]) ** 2) / 2) + 1e-6
    )
    fine.look(probe_of(geometry))
    amplitude = 10 ** (fine.picture / 255.0 * 60 / 20) - 1
    u, v = pixel_places(geometry)
    pixel = max(u[0, 1] - u[0, 0], v[1, 0] - v[0, 0])
    assert [np.average(u, weights=amplitude), np.average(v, weights=amplitude)] == pytest.approx(
        target, abs=pixel / 2
    )


@pytest.mark.parametrize("off_sd", [0.0, 0.6, 1.0, 1.2, 2.0])
def test_a_target_off_the_plane_is_dimmed_as_the_thick_plane_weighs_it(off_sd):
    probe = probe_of(elevation_width_mm=4.0)
    thickness = elevation_sd_mm(probe)
    assert thickness == pytest.approx(4.0 / np.sqrt(8 * np.log(2)))
    tank = Tank((1e4, 1e4, 0.1), (1, 1, 161), (0.0, 0.0, -8.0))

    def target(offset):
        return 1e-4 + 0.5 * np.exp(-0.5 * ((offset - off_sd) / 0.3) ** 2)

    tank.fill(TISSUE_Z, lambda x, y, z: target(z / thickness), 0.1)
    lossy = tank.look(probe, "elevation")
    tank.fill(TISSUE_Z, 0.0, lambda x, y, z: target(z / thickness))
    seen = tank.look(probe, "elevation")
    tank.fill(TISSUE_Z, 0.0, 0.1)
    uniform = tank.look(probe, "elevation")
    # Planes at 0, -1.2 and 1.2 SD with weights as 1 to 1/2 to 1/2: exp(-1.2^2 / 2) is 0.49.
    weighed = (target(0.0) + target(-1.2) / 2 + target(1.2) / 2) / 2
    # The same scatterers, so sample by sample; chords of the Gaussian over voxels of 0.06 SD are 0.06^2 / 8 / 0.3^2 off.
    assert np.abs(seen - uniform - 20 * np.log10(weighed / 0.1)).max() < 0.05
    lost = 0.2 * weighed * probe.frequency_mhz * sample_depths(probe)
    assert np.abs(uniform - lossy - lost).max() < 0.01 * lost[-1]


def test_gain_and_its_course_over_depth_are_added(fine):
    plain = probe_of()
    louder = probe_of(
        gain_percent=70.0, depth_compensation_db_cm_mhz=0.5, time_gain_compensation=(50.0,) * 4 + (80.0,) * 4
    )
    fine.fill(attenuation=0.5, backscatter=0.1)
    added = fine.look(louder, "speckle") - fine.look(plain, "speckle")
    assert np.abs(added - louder.gain_db()).max() < 1e-3
    assert np.ptp(louder.gain_db()) > 60.0


def test_a_probe_of_other_lines_or_samples_is_refused(fine):
    for other in (probe_of(number_of_scanlines=128), probe_of(number_of_samples_per_scanline=320)):
        with pytest.raises(ValueError, match=f"made for {LINES} of {SAMPLES}"):
            fine.look(other)
    with pytest.raises(ValueError, match="648 samples a line: expected a multiple of 16"):
        BMode(fine.tissue, fine.tissue, fine.plane, probe_of(number_of_samples_per_scanline=648), 0.5)
