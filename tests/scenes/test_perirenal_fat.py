"""Fat around an organ: its thickness in a drawn CT, where it is removed, and how stiff it is."""

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from pydantic import ValidationError

from scenes.anatomy import load_anatomy
from scenes.perirenal_fat import REACH_MM, RIM_MM, STEP_MM, fat_thickness, foundation_kpa_mm, removed
from scenes.scene import Attachment, load_scene, scene_file
from scenes.volumes.voxel_grid import VoxelGrid
from tests.ball_patient import folder_of_ball

ORGAN_HU, FAT_HU, MUSCLE_HU, GAS_HU = 60.0, -100.0, 50.0, -1000.0
SPACING_MM, HALF_MM = 1.5, 15.0
NAMES = ("left", "right", "back", "front", "head", "feet")
SIDES = dict(zip(NAMES, np.repeat(np.eye(3), 2, axis=0) * np.tile([1, -1], 3)[:, None], strict=True))


@pytest.fixture(scope="module")
def block() -> trimesh.Trimesh:
    """The organ: a cube of 30 mm about the origin."""
    cube = trimesh.creation.box(extents=[2 * HALF_MM] * 3)
    for _ in range(3):
        cube = cube.subdivide()
    return cube


@pytest.fixture(scope="module")
def ct() -> tuple[np.ndarray, VoxelGrid]:
    """HU (nx, ny, nz): beside the organ 8 mm of fat before muscle on its left, and none on its right; behind
    20 mm; in front gas after 12 mm of fat; above fat alone; below the CT ends after 10.5 mm of fat.
    """
    low = np.array([-75.0, -75.0, -25.5])
    x, y, z = np.meshgrid(*(np.arange(a, 75.0, SPACING_MM) for a in low), indexing="ij")
    hu = np.full(x.shape, FAT_HU, np.float32)
    hu[(x > HALF_MM + 8) | (x < -HALF_MM) | (y > HALF_MM + 20)] = MUSCLE_HU
    hu[y < -HALF_MM - 12] = GAS_HU
    hu[np.maximum.reduce([abs(x), abs(y), abs(z)]) <= HALF_MM] = ORGAN_HU
    return hu, VoxelGrid(x.shape, np.full(3, SPACING_MM), low, np.eye(3))


def middle_of(block: trimesh.Trimesh, side: str) -> np.ndarray:
    """The faces in the middle of a side of the block, whose normals are its own."""
    outward = SIDES[side]
    across = block.triangles_center - np.outer(block.triangles_center @ outward, outward)
    return (block.face_normals @ outward > 0.99) & (np.abs(across).max(axis=1) < HALF_MM / 2)


@pytest.mark.parametrize(
    "side, thickness_mm", [*zip(NAMES, [8.0, RIM_MM, 20.0, np.nan, REACH_MM, np.nan], strict=True)]
)
def test_a_layer_is_as_thick_as_it_was_drawn(block, ct, side, thickness_mm):
    hu, grid = ct
    thickness = fat_thickness(block, hu, grid.index_from_mm)[middle_of(block, side)]
    # The border is drawn to half a voxel, and sampled by steps.
    np.testing.assert_allclose(thickness, thickness_mm, atol=SPACING_MM / 2 + STEP_MM)


def test_a_vessel_in_the_fat_does_not_end_it(block, ct):
    hu, grid = ct
    x = np.arange(hu.shape[1]) * SPACING_MM - 75.0
    with_vessel = hu.copy()
    with_vessel[:, (x > HALF_MM + 9) & (x < HALF_MM + 11), :] = MUSCLE_HU
    thickness = fat_thickness(block, with_vessel, grid.index_from_mm)[middle_of(block, "back")]
    np.testing.assert_allclose(thickness, 20.0, atol=SPACING_MM / 2 + STEP_MM)


def test_the_place_of_the_ct_counts_not_its_axes(block, ct):
    hu, grid = ct
    turned = VoxelGrid(
        grid.size, grid.spacing, grid.place([s - 1 for s in grid.size]), np.diag([-1.0, -1.0, -1.0])
    )
    np.testing.assert_allclose(
        fat_thickness(block, hu[::-1, ::-1, ::-1].copy(), turned.index_from_mm),
        fat_thickness(block, hu, grid.index_from_mm),
        atol=STEP_MM,
    )


def test_fat_in_a_hollow_ties_the_organ_to_nothing():
    cup = trimesh.creation.box(extents=[60, 60, 40]).difference(
        trimesh.creation.box(extents=[20, 60.1, 30]).apply_translation([0, 0, 10]), engine="manifold"
    )
    for _ in range(2):
        cup = cup.subdivide()
    grid = VoxelGrid((60, 60, 60), np.full(3, 3.0), np.full(3, -90.0), np.eye(3))
    thickness = fat_thickness(cup, np.full(grid.size, FAT_HU, np.float32), grid.index_from_mm)
    centre = cup.triangles_center
    walls = (np.abs(np.abs(centre[:, 0]) - 10) < 0.1) & (np.abs(centre[:, 1:]) < 10).all(axis=1)
    assert walls.any() and np.isinf(thickness[walls]).all()
    assert np.isfinite(thickness[np.abs(centre[:, 0]) > 29.9]).all()


def test_stiffness_is_the_modulus_over_the_thickness(block):
    thickness = np.full(len(block.faces), 8.0)
    thickness[0], thickness[1] = np.nan, np.inf
    attachment = Attachment(fat_young_kpa=3.0, fat_kpa_mm=0.25, freed_deg=0.0)
    stiffness = foundation_kpa_mm(attachment, block, None, thickness, np.array([0.0, -1.0, 0.0]))
    assert stiffness[0] == 0.25 and stiffness[1] == 0.0
    np.testing.assert_allclose(stiffness[2:], 3.0 / 8.0)
    # Without a CT, or without a modulus, all of it is as where the CT does not show it.
    for other, shown in ((attachment, None), (Attachment(fat_kpa_mm=0.25, freed_deg=0.0), thickness)):
        np.testing.assert_array_equal(
            foundation_kpa_mm(other, block, None, shown, np.array([0.0, -1.0, 0.0])), 0.25
        )


def test_the_side_of_the_approach_is_freed(block):
    press = np.array([0.0, -2.0, 0.0])
    freed = removed(Attachment(), block, None, press)
    np.testing.assert_array_equal(freed, block.face_normals @ SIDES["front"] > 0.5)
    # What the scene names wins over the press; its length does not count.
    lateral = removed(Attachment(approach=(5.0, 0.0, 0.0)), block, None, press)
    np.testing.assert_array_equal(lateral, block.face_normals @ SIDES["left"] > 0.5)
    ball = trimesh.creation.icosphere(subdivisions=4)
    for angle in (0.0, 60.0, 120.0, 180.0):
        share = ball.area_faces[removed(Attachment(freed_deg=angle), ball, None, press)].sum() / ball.area
        assert share == pytest.approx((1 - np.cos(np.radians(angle))) / 2, abs=0.01)


def test_the_surface_over_a_tumour_is_freed(block):
    tumour = trimesh.creation.icosphere(subdivisions=4, radius=5.0).apply_translation([0.0, 12.0, 0.0])
    freed = removed(Attachment(freed_deg=0.0, freed_margin_mm=6.0), block, tumour, SIDES["front"])
    away = np.linalg.norm(block.triangles_center - [0.0, 12.0, 0.0], axis=1) - 5.0
    np.testing.assert_array_equal(freed[np.abs(away - 6.0) > 0.1], (away <= 6.0)[np.abs(away - 6.0) > 0.1])
    assert 0 < freed.sum() < len(freed) / 4
    assert not removed(Attachment(freed_deg=0.0, freed_margin_mm=0.0), block, tumour, SIDES["front"]).any()


def test_a_scene_has_the_thickness_that_its_ct_shows(tmp_path):
    folder = folder_of_ball(tmp_path)
    plain = load_scene(scene_file(folder))
    assert load_anatomy(plain, folder).fat_mm is None
    image = sitk.GetImageFromArray(np.full((40, 40, 40), FAT_HU, np.float32))
    image.SetSpacing([4.0] * 3)
    image.SetOrigin([30.0 - 78, -40.0 - 78, 20.0 - 78])
    sitk.WriteImage(image, folder / "ct.nrrd")
    text = (folder / "scene.toml").read_text()
    text = text.replace("[tissue]", 'ct = "ct.nrrd"\n[tissue]', 1)
    (folder / "scene.toml").write_text(text.replace("[attachment]", "[attachment]\nfat_young_kpa = 3.0"))
    anatomy = load_anatomy(load_scene(scene_file(folder)), folder)
    np.testing.assert_array_equal(anatomy.fat_mm, np.full(len(anatomy.organ.faces), REACH_MM))


@pytest.mark.parametrize(
    "values, sentence",
    [
        ({"approach": (0.0, 0.0, 0.0)}, "a direction must not be zero"),
        ({"freed_deg": 200.0}, "less than or equal to 180"),
        ({"fat_young_kpa": -1.0}, "greater than or equal to 0"),
    ],
)
def test_values_out_of_range_are_refused(values, sentence):
    with pytest.raises(ValidationError, match=sentence):
        Attachment(**values)
