"""Tissues around a kidney, on a made abdomen: by phase, side, and however the CT's axes are stored."""

from functools import cache

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from made_abdomen import Abdomen, abdomen, as_before
from scipy import ndimage
from skimage.measure import marching_cubes

from scenes.tissue_classes.tissue_map import CODE, TissueMap, tissue_map

OF_MUSCLE = "muscle", "perimysium"


@cache
def made(*arguments) -> tuple[Abdomen, TissueMap]:
    body = abdomen(*arguments)
    return body, tissue_map(body.hu, body.labels, body.organ, body.index_from_mm)


def recall(body: Abdomen, classes: TissueMap, structure: str, *tissues: str, where=None) -> float:
    """The share of a structure's voxels that have one of some tissues."""
    mask = body.truth == structure if where is None else (body.truth == structure) & where
    return float(classes.mask(*tissues)[on_finer(mask, classes)].mean())


def places(shape: tuple[int, ...], index_from_mm: np.ndarray) -> np.ndarray:
    """LPS [mm] of voxels, (nx, ny, nz, 3)."""
    index = np.moveaxis(np.indices(shape), 0, -1)
    return (index - index_from_mm[:3, 3]) @ np.linalg.inv(index_from_mm[:3, :3]).T


def on_finer(mask: np.ndarray, classes: TissueMap) -> np.ndarray:
    """A mask of a CT's voxels on the grid of its tissues."""
    for axis, factor in enumerate(np.array(classes.codes.shape) // mask.shape):
        mask = mask.repeat(factor, axis)
    return mask


def away_from_wall(body: Abdomen) -> np.ndarray:
    at = places(body.truth.shape, body.index_from_mm)
    return np.hypot(at[..., 0] / 165, at[..., 1] / 110) < 0.79


SIDES = [("left", True), ("left", False), ("right", True), ("right", False)]


@pytest.mark.parametrize("side, enhanced", SIDES)
def test_fat_gas_bone_and_bowel_are_known_by_their_hu(side, enhanced):
    body, classes = made(side, enhanced)
    # Of sharp edges blurred over a voxel of 3 mm, up to half a voxel on either side is of the other side.
    for structure, tissues, least in (
        ("bone", ("bone",), 0.95),
        ("marrow", ("bone",), 0.95),
        ("gas", ("gas",), 0.9),
        ("fat", ("fat", "fascia"), 0.9),
        ("bowel", ("bowel",), 0.7),
    ):
        assert recall(body, classes, structure, *tissues) > least, structure
    assert recall(body, classes, "air", "gas") > 0.95


@pytest.mark.parametrize("side, enhanced", SIDES)
def test_the_liver_is_beside_the_right_kidney_and_the_spleen_beside_the_left(side, enhanced):
    body, classes = made(side, enhanced)
    organ, other = ("spleen", "liver") if side == "left" else ("liver", "spleen")
    assert recall(body, classes, organ, organ) > 0.9
    assert not classes.mask(other).any()


@pytest.mark.parametrize("side, enhanced", SIDES)
def test_muscle_beside_the_spine_is_muscle_in_every_phase(side, enhanced):
    body, classes = made(side, enhanced)
    assert recall(body, classes, "muscle", *OF_MUSCLE, where=away_from_wall(body)) > 0.9
    for organ in ("liver", "spleen"):
        assert recall(body, classes, organ, *OF_MUSCLE) < 0.02


@pytest.mark.parametrize("side", ["left", "right"])
def test_with_contrast_agent_the_wall_of_the_abdomen_is_muscle_too(side):
    body, classes = made(side, True)
    # What is nearer to the ball in liver or spleen than to one in muscle is of their body.
    assert recall(body, classes, "muscle", *OF_MUSCLE, where=~away_from_wall(body)) > 0.7


@pytest.mark.parametrize("side, enhanced", SIDES)
def test_blood_is_known_by_contrast_agent_alone(side, enhanced):
    body, classes = made(side, enhanced)
    if enhanced:
        assert recall(body, classes, "vessel", "vessel") > 0.6
    else:
        assert not classes.mask("vessel").any()


AS_STORED = (3.0, 3.0, 4.0), (0, 1, 2), (False, False, False)


@pytest.mark.parametrize("side", ["left", "right"])
def test_blood_hardly_brighter_than_the_liver_is_known_in_wide_vessels(side):
    # The median of the liver is 115 HU, so that noise of 8 HU reaches what blood has.
    body, classes = made(side, True, *AS_STORED, (("vessel", 138),))
    assert recall(body, classes, "vessel", "vessel") > 0.6
    # The organ beside the other kidney is soft tissue like any other.
    for organ in ("spleen" if side == "left" else "liver", "muscle"):
        assert recall(body, classes, organ, "vessel") < 0.01, organ


@pytest.mark.parametrize("hu", [300, 450])
@pytest.mark.parametrize("side", ["left", "right"])
def test_vessels_as_bright_as_bone_in_the_arterial_phase_are_no_bone_and_no_bowel(side, hu):
    body, classes = made(side, True, *AS_STORED, (("vessel", hu),))
    assert recall(body, classes, "vessel", "vessel") > 0.95
    assert recall(body, classes, "bone", "bone") > 0.95 and recall(body, classes, "marrow", "bone") > 0.95
    assert max(recall(body, classes, "bone", "vessel"), recall(body, classes, "fat", "bone")) < 0.005


def test_marrow_as_bright_as_arteries_is_bone():
    body, classes = made("left", True, *AS_STORED, (("marrow", 320),))
    assert recall(body, classes, "marrow", "bone") > 0.95


def test_contrast_agent_in_the_bowel_away_from_the_spine_is_no_artery():
    # As long as the CT, as a descending colon is.
    body = abdomen("left", True)
    at = places(body.truth.shape, body.index_from_mm)
    colon = np.hypot(at[..., 0] - 70, at[..., 1] + 40) < 12
    hu = np.where(colon, 400, body.hu)
    classes = tissue_map(hu, body.labels, body.organ, body.index_from_mm)
    colon = on_finer(colon, classes)
    # Its rim has the HU of blood by partial volume.
    assert classes.mask("bowel")[colon].mean() > 0.8 and classes.mask("vessel")[colon].mean() < 0.1


@pytest.mark.parametrize("enhanced", [True, False])
def test_the_gallbladder_is_fluid(enhanced):
    body, classes = made("right", enhanced)
    # Its radius is 15 mm, of which the partial volume of its border takes a voxel of 3 mm.
    assert recall(body, classes, "bile", "fluid") > 0.5
    for structure in ("liver", "muscle", "fat", "vessel"):
        assert recall(body, classes, structure, "fluid") < 0.01, structure


@pytest.mark.parametrize("side, enhanced", SIDES)
def test_parenchyma_is_within_the_surface_and_nothing_of_the_surroundings_in_it(side, enhanced):
    body, classes = made(side, enhanced)
    at = places(classes.codes.shape, classes.index_from_mm)
    away = np.linalg.norm((at - body.organ.center_mass) / (np.ptp(body.organ.vertices, axis=0) / 2), axis=-1)
    parenchyma = classes.mask("kidney", "cortex", "medulla")
    # The surface's grid of 2 mm is right to 0.1 mm about an ellipsoid of 20 mm or more: half a percent of its
    # size.
    assert parenchyma[away < 0.98].all() and not parenchyma[away > 1.02].any()
    # Between kidney and fat no film of another tissue: it would be an interface of its own. What touches the
    # other organs is left out.
    shell = (away > 1.02) & (away < 1.1)
    assert classes.mask("soft-tissue")[shell].mean() < 0.1


@cache
def turned(axes=(0, 1, 2), mirrored=(False, False, False)) -> np.ndarray:
    """Codes of the abdomen from a CT stored otherwise, as if it were not."""
    body = abdomen("left", True, axes=axes, mirrored=mirrored)
    classes = tissue_map(body.hu, body.labels, body.organ, body.index_from_mm, draws=False)
    return as_before(classes.codes, axes, mirrored)


@pytest.mark.parametrize(
    "axes, mirrored",
    [((0, 1, 2), (True, True, False)), ((2, 0, 1), (False, True, True)), ((1, 0, 2), (True, False, False))],
)
def test_tissues_do_not_depend_on_how_the_axes_are_stored(axes, mirrored):
    usual, other = turned(), turned(axes, mirrored)
    # The surface's distances are rounded otherwise, and bodies of equal depth may meet elsewhere.
    assert (other == usual).mean() > 0.998
    for tissue in ("muscle", "spleen", "bone", "bowel", "vessel", "kidney"):
        one, two = usual == CODE[tissue], other == CODE[tissue]
        assert 2 * (one & two).sum() > 0.99 * (one.sum() + two.sum()), tissue


@pytest.mark.parametrize("side", ["left", "right"])
def test_thick_slices_have_the_same_tissues(side):
    body = abdomen(side, True, (2.5, 2.5, 6.0))
    classes = tissue_map(body.hu, body.labels, body.organ, body.index_from_mm)
    assert (np.linalg.norm(np.linalg.inv(classes.index_from_mm[:3, :3]), axis=0) <= 1.6).all()
    organ = "spleen" if side == "left" else "liver"
    assert recall(body, classes, organ, organ) > 0.9
    assert recall(body, classes, "muscle", *OF_MUSCLE, where=away_from_wall(body)) > 0.9
    assert recall(body, classes, "bone", "bone") > 0.9 and recall(body, classes, "fat", "fat", "fascia") > 0.9


def slices_of(labels: sitk.Image, value: int, beside_mm: float = 30.0) -> slice:
    """The axial slices of a label, and some beside them."""
    at = np.flatnonzero((sitk.GetArrayViewFromImage(labels) == value).any(axis=(1, 2)))
    beside = round(beside_mm / labels.GetSpacing()[2])
    return slice(int(max(at[0] - beside, 0)), int(at[-1] + beside))


@pytest.mark.parametrize("kidney, organ", [(1, "spleen"), (2, "liver")])
def test_on_a_real_unenhanced_ct_nearly_all_of_liver_and_spleen_are_found(data, kidney, organ):
    """Against TotalSegmentator's organs; what else is taken for them has no bar."""
    folder = data / "ct" / "totalseg"
    images = [folder / "ct.nii.gz", folder / "kidneys.nii.gz", folder / "organs" / f"{organ}.nii.gz"]
    if not all(path.is_file() for path in images):
        pytest.skip("no TotalSegmentator test CT in ../shared/data")
    ct, kidneys, truth = (sitk.ReadImage(str(path)) for path in images)
    kidneys, ct = (image[:, :, slices_of(kidneys, kidney)] for image in (kidneys, ct))
    voxels = [sitk.GetArrayFromImage(image).transpose(2, 1, 0) for image in (ct, kidneys)]
    mm_from_index = np.eye(4)
    mm_from_index[:3, :3] = np.array(ct.GetDirection()).reshape(3, 3) * ct.GetSpacing()
    mm_from_index[:3, 3] = ct.GetOrigin()
    mask = ndimage.gaussian_filter((voxels[1] == kidney).astype(float), 0.8)
    vertices, faces, _, _ = marching_cubes(mask, 0.5)
    surface = trimesh.Trimesh(vertices @ mm_from_index[:3, :3].T + mm_from_index[:3, 3], faces)
    trimesh.repair.fix_normals(surface)
    labels = np.where(voxels[1] == kidney, CODE["kidney"], 0).astype(np.uint8)
    classes = tissue_map(voxels[0], labels, surface, np.linalg.inv(mm_from_index))
    # Of each voxel of the organ, those of the finer grid.
    near = sitk.Resample(truth, ct, interpolator=sitk.sitkNearestNeighbor)
    own = on_finer(sitk.GetArrayFromImage(near).transpose(2, 1, 0) > 0, classes)
    assert own.sum() > 1000 and classes.mask(organ)[own].mean() > 0.9
