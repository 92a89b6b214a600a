"""A whole scene: at rest its slice is the CT, pressed it gives way, and twice it gives the same bits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from coarse_patient import thinned
from slicing import hounsfield, organ_mask

from rehearsal.case import case_of
from rehearsal.imaging import image_view
from rehearsal.live_settings import initial_settings
from rehearsal.rehearsal import Rehearsal, script_length_s
from scenes.anatomy import load_anatomy
from scenes.patients.patient_folder import save_patient
from scenes.patients.patient_import import import_patient
from scenes.patients.patient_scene import patient_scene
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_maps import LabelMap
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import PAPER, Press, Scene, load_scene, with_options
from scenes.surfaces import translated
from scenes.volumes.lazy_volume import LazyVolume
from settings import with_values
from sim.fields import array_of
from sim.signed_distance import signed_distance
from ultrasound.persistence import Persistence
from ultrasound.scanner import B_MODE

pytestmark = pytest.mark.usefixtures("arrays_stored")

LOOK = ("both", "speckle", 350, 40)
LOOK_AT_CT = ("ct", "speckle", 350, 40)
CRLM = "crlm_1004", "crlm_1004_labels/kidneys_provisional.nii.gz"
# No axis is where it was and two run backwards: whatever mixes up axes, directions or spacings is seen.
AXES = "SRA"


def phantom() -> tuple[Scene, Path]:
    """A coarse scene of the embedded patient, and the folder of its files."""
    return with_options(load_scene(PAPER), {"tissue.cell_mm": 6.0}), phantom_folder()


def real_patient(data: Path, tmp_path: Path) -> tuple[Scene, Path]:
    """A coarse scene of a patient on a slab, and the folder of its files."""
    ct, labels = (sitk.DICOMOrient(open_ct(data / "ct" / name).image(), AXES) for name in CRLM)
    slab = trimesh.creation.box([60.0, 10.0, 80.0])
    slab.apply_translation([-57.0, 52.0, -322.0])
    slab.export(tmp_path / "slab.stl")
    patient = import_patient(
        LazyVolume.of(ct), LabelMap.of(labels), side="right", support=str(tmp_path / "slab.stl")
    )
    save_patient(patient, tmp_path / "patient")
    return with_options(patient_scene(patient), {"tissue.cell_mm": 6.0}), tmp_path / "patient"


@pytest.fixture(scope="module")
def built(one_device) -> Rehearsal:
    scene, folder = phantom()
    whole = load_anatomy(scene, folder)
    anatomy = replace(whole, ct=thinned(whole.ct), labels=thinned(whole.labels))
    return Rehearsal(case_of(scene, anatomy), anatomy)


@pytest.fixture
def rehearsal(built) -> Rehearsal:
    built.reset()
    return built


def press(rehearsal: Rehearsal) -> None:
    """The scripted press, in 31 steps, and as many until the tissue has yielded."""
    for step in range(61):
        rehearsal.advance(rehearsal.scripted_pose(min(step / 30, 1.0) * script_length_s(rehearsal.case)))
    rehearsal.show()


def images(rehearsal: Rehearsal, look=LOOK) -> dict[str, np.ndarray]:
    """Of the frame that is shown."""
    anatomy = rehearsal.anatomy
    return anatomy.scanner.images(anatomy.image_plane(), rehearsal.case.probe, *look).by_name


def resampled(folder: Path, plane, origin: np.ndarray, pixels: int) -> np.ndarray:
    """SimpleITK's oblique resample of the patient's CT on a plane given relative to an origin (LPS)."""
    grid = sitk.Image(pixels, pixels, 1, sitk.sitkFloat32)
    spacing = np.array([plane.width_mm, plane.depth_mm]) / pixels
    grid.SetSpacing((*spacing.tolist(), 1.0))
    grid.SetDirection(plane.world_from_plane[:3, :3].flatten().tolist())
    first = plane.world_from_plane @ [-plane.width_mm / 2 + spacing[0] / 2, spacing[1] / 2, 0, 1]
    grid.SetOrigin((first[:3] + origin).tolist())
    ct = sitk.Cast(sitk.ReadImage(str(folder / "ct.nrrd")), sitk.sitkFloat32)
    return sitk.GetArrayFromImage(sitk.Resample(ct, grid, sitk.Transform(), sitk.sitkLinear, -1000.0))[0]


def assert_at_rest_the_slice_is_the_ct(scene: Scene, folder: Path) -> None:
    scene = scene.model_copy(update={"press": Press(warm_up_steps=0)})
    loaded = load_anatomy(scene, folder)
    rehearsal = Rehearsal(case_of(scene, loaded), loaded)
    anatomy = rehearsal.anatomy
    rehearsal.manipulator.turn(20, 10, 35)
    rehearsal.organ.pose = rehearsal.manipulator.pose()
    rehearsal.show()
    images(rehearsal, LOOK_AT_CT)
    cut, pixels = anatomy.scanner.ct_slice, scene.image.pixels
    inside = organ_mask(cut)
    there = resampled(folder, anatomy.image_plane(), rehearsal.case.origin, pixels)
    difference = np.abs(hounsfield(cut) - there)
    print(f"mean {difference[inside].mean():.4f} HU, maximum {difference[inside].max():.3f} HU")
    assert inside.mean() > 0.1
    # The bar is 5 HU; float32 positions (1e-5 mm) in gradients of 500 HU/mm leave far less.
    assert difference[inside].mean() < 0.05


def test_at_rest_the_slice_is_the_embedded_patients_ct(one_device):
    assert_at_rest_the_slice_is_the_ct(*phantom())


def test_at_rest_the_slice_is_a_real_ct_however_its_voxels_lie(one_device, data, tmp_path):
    assert_at_rest_the_slice_is_the_ct(*real_patient(data, tmp_path))


def test_pressing_moves_the_tissue_and_the_slice_follows(rehearsal):
    anatomy, before, top = rehearsal.anatomy, images(rehearsal), rehearsal.anatomy.vertices
    press(rehearsal)
    assert rehearsal.indentation_mm() == pytest.approx(12.38)
    assert ((anatomy.vertices - top) @ rehearsal.case.gravity_direction).max() > 6.0
    pressed = images(rehearsal)
    assert list(pressed) == ["B-mode", "CT"]
    assert all(np.abs(pressed[name].astype(int) - before[name]).mean() > 10 for name in before)
    assert 0.97 < anatomy.volume_ratio() < 1.0
    assert rehearsal.organ.contacts.measure_penetration() <= 0.5
    rehearsal.reset()
    after = images(rehearsal)
    assert all(np.array_equal(after[name], before[name]) for name in before)
    assert rehearsal.indentation_mm() == pytest.approx(0.0, abs=1e-6)


def test_a_pixel_shows_the_tissue_that_is_there_now(rehearsal):
    press(rehearsal)
    images(rehearsal, LOOK_AT_CT)
    anatomy, count = rehearsal.anatomy, rehearsal.case.scene.image.pixels
    plane = anatomy.image_plane()
    pixels = np.argwhere(organ_mask(anatomy.scanner.ct_slice))[::1009]
    spacing = np.array([plane.width_mm, plane.depth_mm]) / count
    local = (pixels[:, ::-1] + 0.5) * spacing - [plane.width_mm / 2, 0]
    shown_at = np.column_stack([local, np.zeros(len(local)), np.ones(len(local))]) @ plane.world_from_plane.T
    rest = anatomy.scanner.plane.rest_grid(count)[pixels[:, 0], pixels[:, 1]]
    off = np.linalg.norm(array_of(anatomy.skin(rest).vertices) - shown_at[:, :3], axis=1)
    unmoved = np.linalg.norm(rest - shown_at[:, :3], axis=1)
    assert len(off) > 50 and unmoved.mean() > 2.0
    # Cells of 8 mm are straight where the clusters bend: under a tenth of the motion on average.
    assert off.mean() < 0.1 * unmoved.mean()


def test_a_hand_cannot_outrun_its_speed(rehearsal):
    away = rehearsal.frame.pose.copy()
    away[:3, 3] += [0, -100.0, 0]
    moved = rehearsal.manipulator.pose_towards(away, rehearsal.frame.pose, 1 / 60)
    assert np.linalg.norm(moved[:3, 3] - away[:3, 3]) == pytest.approx(100.0 - 150.0 / 60)


def test_the_transducer_goes_over_the_organ_not_through_it(rehearsal):
    manipulator, down = rehearsal.manipulator, rehearsal.case.gravity_direction
    across = 30 * np.array(rehearsal.case.press.lateral)
    ends = [manipulator.vertices.mean(axis=0) + side * across - 60 * down for side in (-1, 1)]

    def deepest(end: np.ndarray) -> float:
        """On the way to a place above the organ [mm]."""
        manipulator.point(end, down)
        depths = []
        for _ in range(90):
            goal = manipulator.pose_towards(manipulator.pose(), rehearsal.organ.pose, 1 / 60)
            rehearsal.advance(goal)
            depths.append(rehearsal.indentation_mm())
        return max(depths)

    deepest(ends[0])
    there = rehearsal.organ.pose.copy()
    # A straight way would cut several millimetres deep into the organ's curve.
    assert deepest(ends[1]) < 0.5
    assert np.linalg.norm(rehearsal.organ.pose[:3, 3] - there[:3, 3]) > 30
    assert rehearsal.organ.pose == pytest.approx(manipulator.pose(), abs=1e-6)


def test_every_feature_at_once_without_a_ct_stays_finite_and_out_of_everything(one_device, tmp_path):
    trimesh.creation.icosphere(subdivisions=3, radius=20.0).export(tmp_path / "organ.stl")
    grid = np.indices((31, 31, 11)).transpose(1, 2, 3, 0) * 2.0 - [30, 30, 34]
    bed = sitk.GetImageFromArray(
        (grid[..., 2] + 19.0 - 0.1 * np.abs(grid[..., 0])).transpose(2, 1, 0).astype(np.float32)
    )
    bed.SetSpacing((2.0, 2.0, 2.0))
    bed.SetOrigin((-30.0, -30.0, -34.0))
    sitk.WriteImage(bed, str(tmp_path / "bed.nrrd"))
    scene = Scene(
        anatomy={},
        tissue=dict(model="shape-matching", radius_mm=3.0, surface_samples_per_mm2=0.5),
        solver=dict(relaxation="global", relaxation_factor=1.5, mass_scaling_per_mm=0.02),
        gravity=dict(direction=(0, 0, -1)),
        contact=dict(particles=True),
        shape=(dict(kind="sdf", file="bed.nrrd"), dict(kind="plane", normal=(0, 0.2, 1), offset_mm=-21.0)),
        press=dict(direction=(0.2, 0, -1), warm_up_steps=20, indentations_mm=(5.95, 9.48, 12.38)),
    )
    loaded = load_anatomy(scene, tmp_path)
    rehearsal = Rehearsal(case_of(scene, loaded), loaded)
    assert rehearsal.organ.model.relaxation == "global"
    for step in range(31):
        rehearsal.advance(rehearsal.scripted_pose(step / 30 * script_length_s(rehearsal.case)))
        assert rehearsal.organ.contacts.measure_penetration() <= 1e-3
    rehearsal.show()
    anatomy = rehearsal.anatomy
    assert np.isfinite(rehearsal.frame.positions).all()
    assert 0.6 < anatomy.volume_ratio() < 1.1
    assert anatomy.scanner is None and anatomy.rest_grid() is None
    view = image_view(anatomy, initial_settings(rehearsal.case))
    assert not any(image.any() for image in view.images.values())


def test_an_image_has_the_rows_and_columns_asked_for_and_at_most_the_scenes(rehearsal):
    case = rehearsal.case
    pixels, times = case.scene.image.pixels, []
    for asked, made in (
        ((40, 30), (40, 30)),
        ((pixels + 1, 30), (pixels, 30)),
        ((30, pixels + 1), (30, pixels)),
    ):
        view = image_view(rehearsal.anatomy, initial_settings(case), times, asked)
        assert {image.shape[:2] for image in view.images.values()} == {made}
    assert len(times) == 3 and min(times) > 0


def test_an_image_that_is_saved_leaves_the_persistence_of_those_shown_as_it_is(rehearsal):
    values = {"scanner.persistence_percent": 60, "image.mode": "b-mode"}
    settings = with_values(initial_settings(rehearsal.case), values)
    poses = [rehearsal.pose_at_depth(depth) for depth in (1.0, 2.0, 3.0)]

    def image(pose: np.ndarray, persistence: Persistence | None) -> np.ndarray:
        rehearsal.organ.pose = pose
        rehearsal.show()
        return image_view(rehearsal.anatomy, settings, persistence=persistence).images[B_MODE]

    first, second = Persistence(), Persistence()
    shown = [image(pose, first) for pose in poses]
    alone = []
    for pose, expected in zip(poses, shown, strict=True):
        alone.append(image(pose, None))
        assert np.array_equal(image(pose, second), expected)
    assert np.array_equal(alone[0], shown[0])
    assert all((own != mixed).any() for own, mixed in zip(alone[1:], shown[1:], strict=True))


def test_the_outline_is_the_tumours_border_not_what_is_drawn_of_it(rehearsal):
    for _ in range(20):
        rehearsal.advance(rehearsal.pose_at_depth(6.0))
    rehearsal.show()
    anatomy = rehearsal.anatomy
    outline, plane = anatomy.tumour_outline(), anatomy.image_plane()
    flat = np.column_stack([outline.reshape(-1, 2), np.zeros(2 * len(outline)), np.ones(2 * len(outline))])
    places = (flat @ plane.world_from_plane.T)[:, :3]
    away = signed_distance(anatomy.tumour_vertices, np.asarray(anatomy.tumour.faces), places)[0]
    assert len(outline) > 20 and np.abs(away).max() < 1e-3


@pytest.mark.parametrize("side, at_x", [("left", 60.0), ("right", -60.0)])
def test_the_case_has_the_side_of_its_kidney(side, at_x):
    scene, folder = phantom()
    loaded = load_anatomy(scene, folder)
    moved = translated(loaded.organ, np.array([at_x - loaded.organ.bounds[:, 0].mean(), 0.0, 0.0]))
    case = case_of(scene, replace(loaded, organ=moved))
    # LPS: x is to the left.
    assert case.lateral.tolist() == [1.0 if side == "left" else -1.0, 0.0, 0.0]
