"""A crater in volumes at rest: its HU, acoustic values and distances inside and outside, and what was
there before.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from test_scanner import anatomy

from ultrasound.acoustics import properties
from ultrasound.anatomy_volumes import AnatomyVolumes
from ultrasound.crater import FILLINGS, FINE_MM, Crater
from ultrasound.sampled_volume import AIR_HU, SampledVolume

RADIUS, VOXEL_MM = 9.0, 1.5
MIDDLE = np.array([4.0, -2.0, 3.0])
SURFACE = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS).apply_translation(MIDDLE)
# How far the mesh is inside the ball, and the error of distances between the points of the crater's grid: h^2
# / 8 times two curvatures.
INSET = RADIUS - np.linalg.norm(SURFACE.triangles_center - MIDDLE, axis=1).min()


WITHIN = INSET + FINE_MM**2 / 4 / RADIUS


def volume_of(values: np.ndarray) -> SampledVolume:
    """A volume of oblique voxels around the crater."""
    index_from_mm = np.eye(4)
    index_from_mm[:3, :3] = rotation_about([1, 2, 3], 25) / VOXEL_MM
    index_from_mm[:3, 3] = (np.array(values.shape[:3]) - 1) / 2
    return SampledVolume(values, index_from_mm)


def places(volume: SampledVolume) -> np.ndarray:
    """Centres (x, y, z, 3) of the voxels [mm]."""
    index = np.stack(np.indices(volume.shape), axis=-1)
    return (index - volume.index_from_mm[:3, 3]) @ np.linalg.inv(volume.index_from_mm[:3, :3]).T


def put(volume: SampledVolume, box, values: np.ndarray) -> np.ndarray:
    """All voxels after those of a box were replaced."""
    volume.set_values(box, values)
    return volume.values((slice(None),) * 3)


@pytest.fixture
def from_surface() -> np.ndarray:
    """Distance (x, y, z) [mm] of the voxels from the ball, negative inside."""
    return np.linalg.norm(places(volume_of(np.zeros((32, 30, 28)))) - MIDDLE, axis=-1) - RADIUS


@pytest.mark.parametrize(("filling", "hu"), [("fluid", 10.0), ("air", AIR_HU)])
def test_it_has_the_hu_of_what_fills_it(device, from_surface, filling, hu):
    random = np.random.default_rng(3).normal(50, 10, (32, 30, 28)).astype(np.float32)
    volume, crater = volume_of(random), Crater(SURFACE, filling)
    after = put(volume, *crater.replaced(volume, crater.hu()))
    # Values of 1000 are rounded to 6e-5.
    half = VOXEL_MM / 2
    assert (from_surface < -half).sum() > 300
    assert after[from_surface < -half - WITHIN] == pytest.approx(hu, abs=1e-4)
    np.testing.assert_array_equal(after[from_surface > half + WITHIN], random[from_surface > half + WITHIN])
    # Between, each voxel changes by the share of its width that is inside: the shares sum to the ball's
    # volume. A linear share is exact for a plane; the ball's curvature adds 4 pi h^2 r / 12.
    share = ((after - random) / (hu - random)).sum() * VOXEL_MM**3
    curved = 4 * np.pi * RADIUS * VOXEL_MM**2 / 12
    sampled = 4 * np.pi * RADIUS**2 * INSET
    noise = VOXEL_MM**3 * np.sqrt(4 * np.pi * RADIUS**2 / VOXEL_MM**2) / 2
    assert share == pytest.approx(4 / 3 * np.pi * RADIUS**3, abs=curved + sampled + noise)


def test_distances_are_those_of_what_remains(device, from_surface):
    """A half space below z = 6, of which the crater is taken: the larger of both distances."""
    index = places(volume_of(np.zeros((32, 30, 28))))
    organ = (index[..., 2] - 6.0).astype(np.float32)
    volume, crater = volume_of(organ), Crater(SURFACE, "air")
    after = put(volume, *crater.without(volume))
    near = from_surface < VOXEL_MM
    wanted = np.maximum(organ, -from_surface)
    np.testing.assert_allclose(after[near], wanted[near], atol=INSET + 1e-4)
    inside = (from_surface < -INSET) & (organ < 0)
    assert (after[inside] > 0).all() and inside.sum() > 300
    far = from_surface > 2 * RADIUS
    np.testing.assert_array_equal(after[far], organ[far])


def test_the_box_has_all_voxels_that_it_changes_and_ends_with_the_volume(device):
    volume = volume_of(np.zeros((10, 12, 11), np.float32))
    crater = Crater(SURFACE, "air")
    box, values = crater.replaced(volume, crater.hu())
    assert all(0 <= side.start < side.stop <= n for side, n in zip(box, volume.shape, strict=True))
    assert values.shape == tuple(side.stop - side.start for side in box)
    far = Crater(SURFACE.copy().apply_translation([500.0, 0, 0]), "air")
    assert far.replaced(volume, far.hu())[1].size == 0


NAMES = "ct", "organ", "tissue", "flow", "remnant", "tumour"
EVERYTHING = (slice(None),) * 3
# Across the border of the ball's upper part.
BALL = trimesh.creation.icosphere(subdivisions=3, radius=5.0).apply_translation([0.0, 0.0, 8.0])


def volumes_of_a_ball() -> AnatomyVolumes:
    """A ball of kidney whose upper part is an artery, with a tumour in it."""
    ball = anatomy()
    height = np.indices(ball.labels.shape)[2] - (ball.labels.shape[2] - 1) / 2
    labels = np.where(height > 4, 2 * ball.labels, ball.labels)
    tumour = trimesh.creation.icosphere(subdivisions=3, radius=4.0).apply_translation([0.0, 0.0, 6.0])
    return AnatomyVolumes(replace(ball, labels=labels, tissues={1: "kidney", 2: "artery"}, tumour=tumour))


def values_of(volumes: AnatomyVolumes) -> dict[str, np.ndarray]:
    return {name: getattr(volumes, name).values(EVERYTHING) for name in NAMES}


def filled_with(filling: str) -> np.ndarray:
    """Acoustic values of urine or of air."""
    one = np.ones((1, 1, 1), np.int32)
    if filling == "fluid":
        return properties(10 * one, one, {1: "urine"})[0, 0, 0]
    return properties(int(AIR_HU) * one)[0, 0, 0]


@pytest.mark.parametrize("filling", FILLINGS)
def test_all_volumes_have_the_crater_and_are_restored_to_the_bit(device, filling):
    volumes, crater = volumes_of_a_ball(), Crater(BALL, filling)

    def at_middle(name: str) -> np.ndarray:
        volume = getattr(volumes, name)
        at = volume.index_from_mm @ [0.0, 0.0, 8.0, 1.0]
        return volume.values(EVERYTHING)[tuple(np.rint(at).astype(int)[:3])]

    before = values_of(volumes)
    assert before["flow"].any()
    volumes.set_crater(crater)
    during = values_of(volumes)
    assert at_middle("ct") == crater.hu() and not at_middle("flow").any()
    assert at_middle("tissue") == pytest.approx(filled_with(filling), abs=1e-6)
    # Fluid carries sound, as the organ does; air does not.
    assert np.array_equal(before["organ"], during["organ"]) == (filling == "fluid")
    assert at_middle("organ") * (1 if filling == "air" else -1) > 0
    # Labels show neither as organ or tumour.
    assert at_middle("remnant") > 0 and at_middle("tumour") > 0
    volumes.set_crater(None)
    for name, values in values_of(volumes).items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)


def test_volumes_depend_on_the_present_crater_alone(device):
    """Whatever crater was there before, and whether they were used before or after the cut."""
    early, late, other = volumes_of_a_ball(), volumes_of_a_ball(), BALL.copy().apply_translation([3.0, 0, 0])
    _ = values_of(early)
    for number, crater in enumerate((Crater(other, "air"), Crater(other, "fluid"), Crater(BALL, "air")), 1):
        early.set_crater(crater)
        assert early.version == number
    late.set_crater(crater)
    first, second = values_of(early), values_of(late)
    for name in NAMES:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)
