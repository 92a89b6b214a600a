"""The scanner: that each side of it is given what it asks for.

What a side makes of it has tests of its own.
"""

import gc
import weakref
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from slicing import hounsfield

from sim.embedding import Unmoved
from sim.fields import array_of
from ultrasound.acoustics import acoustic_values
from ultrasound.bmode import Wavefront
from ultrasound.interface import Surface
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane, image_plane, pose_at
from ultrasound.scanned_anatomy import ScannedAnatomy, start_acoustics
from ultrasound.scanner import B_MODE, CT, PlaneImages, Scanner

PIXELS, RADIUS, REACH = 64, 12.0, 20.0
PROBE = Probe(
    transducer_name="test",
    housing_mm=(20.0, 10.0, 20.0),
    transducer_width_mm=20.0,
    number_of_scanlines=32,
    number_of_samples_per_scanline=320,
    depth_mm=60.0,
)


UPRIGHT, TURNED = np.eye(3), np.diag([1.0, -1.0, -1.0])
# HU 32 has the impedance that kidney has.
FAT_HU, KIDNEY_HU = -90, 32


def anatomy(spacing=(1.0, 1.0, 1.0), turn: np.ndarray = UPRIGHT, around_hu: int = FAT_HU) -> ScannedAnatomy:
    """A ball of kidney, in a grid of voxels 40 mm along each edge."""
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = turn * spacing
    counts = np.rint(2 * REACH / np.array(spacing)).astype(int) + 1
    mm_from_index[:3, 3] = -mm_from_index[:3, :3] @ (counts - 1) / 2
    at = np.moveaxis(np.indices(counts), 0, -1) @ mm_from_index[:3, :3].T + mm_from_index[:3, 3]
    labels = (np.linalg.norm(at, axis=-1) < RADIUS).astype(np.int16)
    organ = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    hu = np.where(labels, KIDNEY_HU, around_hu).astype(np.int16)
    return ScannedAnatomy(organ, hu, np.linalg.inv(mm_from_index), labels, {1: "kidney"})


@pytest.fixture(scope="module")
def usual(one_device) -> Scanner:
    """Kernels are compiled for each scanner anew: one for all tests that ask for nothing special."""
    return Scanner(anatomy(), Unmoved(), PROBE, PIXELS)


def plane_at(above: float = 0.0) -> ImagePlane:
    """Of a probe so far above the ball that looks down."""
    face = np.array([0.0, 0.0, RADIUS + above])
    return image_plane(pose_at(face, [0, 0, -1.0], [1.0, 0, 0], 20.0), 20.0, *PROBE.extent_mm)


def echo(scanner: Scanner, plane: ImagePlane) -> np.ndarray:
    """What the middle line holds [dB], but for the gain."""
    scanner.images(plane, PROBE, "b-mode", "reflection", 350.0, 40.0)
    return array_of(scanner.bmode.decibel)[16].astype(float) - PROBE.gain_db()


def test_the_slice_is_windowed_as_asked_for(usual):
    picture = usual.images(plane_at(), PROBE, "ct", "speckle", 400.0, 20.0).by_name[CT]
    wanted = np.clip((hounsfield(usual.ct_slice).astype(float) - 20.0) / 400.0 + 0.5, 0, 1) * 255
    assert np.ptp(wanted) > 50 and np.abs(picture - wanted).max() <= 0.51


@pytest.fixture(scope="module")
def of_60_pixels(one_device) -> Scanner:
    return Scanner(anatomy(), Unmoved(), PROBE, 60)


@pytest.mark.parametrize("shape", [(20, 60), (60, 20), (20, 20)])
def test_an_image_of_fewer_pixels_shows_the_same_places(of_60_pixels, shape):
    scanner = of_60_pixels
    look = plane_at(), PROBE, "both", "speckle", 400.0, 20.0
    whole, smaller = scanner.images(*look).by_name, scanner.images(*look, shape).by_name
    # Of three pixels the middle one has the centre of a pixel three times as large. Maps in float32 differ by
    # rounding, of 30 mm by 2e-6.
    middle = tuple(slice(1, None, 3) if count == 20 else slice(None) for count in shape)
    for name, image in smaller.items():
        assert image.shape == shape and np.ptp(whole[name]) > 50
        assert np.abs(image.astype(int) - whole[name][middle]).max() <= 1
    assert scanner.ground_truth.render().shape == shape
    assert np.array_equal(scanner.images(*look).by_name[B_MODE], whole[B_MODE])


@pytest.mark.parametrize("shape", [(61, 60), (60, 61)])
def test_an_image_has_no_more_pixels_than_the_scene(of_60_pixels, shape):
    with pytest.raises(ValueError, match="at most 60"):
        of_60_pixels.images(plane_at(), PROBE, "ct", "speckle", 400.0, 20.0, shape)


def test_each_image_is_of_the_body_as_it_is_now(usual, monkeypatch):
    looks = []
    monkeypatch.setattr(usual, "embedding", SimpleNamespace(update=lambda: looks.append(1)))
    for count in (1, 2):
        usual.images(plane_at(), PROBE, "ct", "speckle", 400.0, 20.0)
        assert len(looks) == count


def test_acoustics_started_before_give_the_same_image(usual):
    bones, plane = replace(anatomy(), tissues={1: "bone"}), plane_at()
    begun = echo(Scanner(anatomy(), Unmoved(), PROBE, PIXELS, acoustics=start_acoustics(bones)), plane)
    assert np.array_equal(begun, echo(Scanner(bones, Unmoved(), PROBE, PIXELS), plane))
    assert np.abs(begun - echo(usual, plane)).max() > 10.0


# The first is the usual one.
@pytest.mark.parametrize("gap", [1.5, 4.0])
def test_sound_enters_as_near_to_the_organ_as_asked_for(usual, gap):
    scanner = usual if gap == 1.5 else Scanner(anatomy(), Unmoved(), PROBE, PIXELS, contact_gap_mm=gap)
    # A line at the middle has the 1 mm of its element's own contact; facets and distances 2 mm apart are 0.2
    # mm off.
    assert echo(scanner, plane_at(gap - 0.4))[:40].max() > -100.0
    assert echo(scanner, plane_at(gap + 0.4))[:40].max() < -170.0


def test_sound_enters_through_fluid_and_the_ct_is_shown(usual):
    scanner = Scanner(anatomy(), Unmoved(), PROBE, PIXELS, "fluid", contact_gap_mm=4.0)
    assert echo(scanner, plane_at(3.6))[:40].max() > -100.0
    assert echo(scanner, plane_at(4.4))[:40].max() < -170.0
    for made in (scanner, usual):
        made.locate(plane_at(3.0))
    assert np.array_equal(scanner.ct_slice.render(400.0, 20.0), usual.ct_slice.render(400.0, 20.0))


def test_beyond_the_ct_is_silence(usual):
    decibel = echo(usual, plane_at())
    depth = (np.arange(320) + 0.5) * PROBE.sample_mm
    within = depth < RADIUS + REACH - 1.0
    # The array is in touch with the ball for 5 mm to either side; the least that a line holds is 20
    # log10(1e-9).
    assert decibel[within].min() > -120.0 and decibel[depth > RADIUS + REACH + 1.0].max() < -179.9


def test_the_surroundings_reflect_as_gel_or_as_air(one_device):
    depth = (np.arange(320) + 0.5) * PROBE.sample_mm
    border = np.abs(depth - 2 * RADIUS + 1.0) < 2.0
    peak = {}
    for outside in ("gel", "air"):
        # A cyst has neither a renal capsule nor texture; its label ends beyond the organ.
        cyst = replace(anatomy(), labels=np.ones_like(anatomy().labels), tissues={1: "cyst"})
        scanner = Scanner(cyst, Unmoved(), PROBE, PIXELS, outside)
        scanner.bmode.sound.surface = Surface(roughness_mm=0.0, scattered=0.0, scattered_hard=0.0)
        # A millimetre in, so that facets leave no place of the face outside.
        peak[outside] = echo(scanner, plane_at(-1.0))[border].max()
    # Gel reflects (Z - 1.5) / (Z + 1.5) of the sound, air all.
    impedance = acoustic_values("cyst")[0]
    wanted = 20 * np.log10((impedance + 1.5) / (impedance - 1.5))
    assert peak["air"] - peak["gel"] == pytest.approx(wanted, abs=0.5)


def scattering_of(turn: np.ndarray) -> Scanner:
    ball = anatomy(turn=turn, around_hu=KIDNEY_HU)
    return Scanner(ball, Unmoved(), PROBE, PIXELS, contact="tissue")


@pytest.fixture(scope="module")
def scattering(one_device) -> Scanner:
    return scattering_of(UPRIGHT)


def images_of(scanner: Scanner, probe: Probe, above: float = -10.0) -> PlaneImages:
    return scanner.images(plane_at(above), probe, "b-mode", "speckle", 350.0, 40.0)


def b_mode(scanner: Scanner, probe: Probe, above: float = -10.0) -> np.ndarray:
    return images_of(scanner, probe, above).by_name[B_MODE].astype(float)


def test_compounding_averages_the_speckle_of_three_angles(scattering):
    settings = dict(gain_percent=50.0, dyn_range_db=80.0, grey_map="linear")
    one, three = (
        b_mode(scattering, PROBE.model_copy(update=settings | {"compound_angles": n})) for n in (1, 3)
    )
    middle = slice(6, 18), slice(24, 40)
    # The dB of three independent speckles, of 5.6 dB each, have 1 / sqrt(3) of its SD.
    speckle = [np.diff(image[middle], axis=0).std() for image in (three, one)]
    assert speckle[0] / speckle[1] == pytest.approx(3**-0.5, rel=0.2)
    assert three[middle].mean() == pytest.approx(one[middle].mean(), abs=6.0)


def test_images_that_were_steered_for_compounding_are_freed_with_it(one_device):
    scanner = scattering_of(UPRIGHT)
    b_mode(scanner, PROBE.model_copy(update={"compound_angles": 5}))
    steered = [weakref.ref(image) for image in scanner.compounding.steered.values()]
    b_mode(scanner, PROBE.model_copy(update={"compound_angles": 3}))
    gc.collect()
    assert len(steered) == 4 and sum(image() is not None for image in steered) <= 2
    b_mode(scanner, PROBE)
    gc.collect()
    assert not any(image() for image in steered) and not scanner.compounding.steered


def test_an_image_is_the_same_whatever_was_imaged_before(scattering):
    levels, plane, first = ("reflection", "speckle", "elevation"), plane_at(-9.0), {}
    for _ in range(2):
        for level, angles in product(levels, (1, 3)):
            probe = PROBE.model_copy(update={"compound_angles": angles})
            made = scattering.images(plane, probe, "both", level, 350.0, 40.0)
            before = first.setdefault((level, angles), made)
            assert all(np.array_equal(made.by_name[name], before.by_name[name]) for name in (B_MODE, CT))
        other = {"compound_angles": 5, "frequency_mhz": 5.0, "colour_steering_deg": 10.0}
        images = images_of(scattering, PROBE.model_copy(update=other), above=-8.0)
        scattering.doppler(images, "colour", 0.09)
        scattering.iq(images, None, Wavefront.of(images.probe, images.plane.world_from_plane), 0)


def test_doppler_and_signals_of_an_image_are_the_same_again(scattering):
    probe = PROBE.model_copy(update={"velocity_scale_cm_s": 5.0, "wall_filter_cm_s": 0.5})
    images = images_of(scattering, probe)
    reference = Wavefront.of(probe, images.plane.world_from_plane)

    def made() -> list[np.ndarray]:
        signals = scattering.iq(images, None, reference, 0)
        return [scattering.doppler(images, "colour", 0.09), signals.iq, signals.rf, signals.rest_mm]

    assert all(np.array_equal(*both) for both in zip(made(), made(), strict=True))


@pytest.mark.parametrize("mode", ["b-mode", "ct"])
def test_doppler_and_signals_of_another_image_than_the_last_are_refused(scattering, mode):
    images = images_of(scattering, PROBE)
    last = scattering.images(plane_at(-9.0), PROBE, mode, "speckle", 350.0, 40.0)
    refused = [images] if mode == "b-mode" else [images, last]
    for earlier in refused:
        with pytest.raises(ValueError, match="made last"):
            scattering.doppler(earlier, "colour")
        with pytest.raises(ValueError, match="made last"):
            scattering.iq(earlier, None, Wavefront.of(PROBE, earlier.plane.world_from_plane), 0)


def test_images_of_different_steering_have_independent_speckle(scattering):
    settings = dict(gain_percent=50.0, dyn_range_db=80.0, grey_map="linear")
    first, second = (
        b_mode(scattering, PROBE.model_copy(update=settings | {"steering_deg": angle}))
        for angle in (0.0, 0.25)
    )
    # In front of the capsule, which is where it is at any angle.
    middle = slice(4, 12), slice(24, 40)
    # Turned by a quarter of a degree, the same scatterers would be seen alike.
    apart = (np.diff(image[middle], axis=0).ravel() for image in (first, second))
    assert abs(np.corrcoef(*apart)[0, 1]) < 0.3


@pytest.mark.parametrize("turn", ["upright", "turned"])
def test_doppler_of_a_scene_is_shown_over_its_image_and_not_while_clamped(scattering, turn):
    if turn == "turned":
        scattering = scattering_of(TURNED)
    slow = PROBE.model_copy(update={"velocity_scale_cm_s": 5.0, "wall_filter_cm_s": 0.5})
    images = images_of(scattering, slow)
    grey = images.by_name[B_MODE]
    flowing, clamped = (
        scattering.doppler(images, "colour", 0.09, is_clamped) for is_clamped in (False, True)
    )
    coloured = (flowing != grey[..., None]).any(axis=-1)
    assert 0.01 < coloured.mean() < 0.5 and (clamped == grey[..., None]).all(axis=-1).mean() > 0.99
    # Small vessels run outward: below the middle of the ball, away from a probe in it.
    assert (flowing[coloured][:, 0] < flowing[coloured][:, 2]).mean() > 0.8
