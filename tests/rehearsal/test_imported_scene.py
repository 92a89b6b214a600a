"""The scene that an import writes is pressed with any parts; the probe starts on the organ."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from synthetic_body import LEFT, RIGHT, TUMOUR, body, coarsely, drawn

from rehearsal.case import case_of
from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import Move
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.pressed_organ import PressedOrgan
from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import load_anatomy
from scenes.mechanical_tissues import mechanical_properties
from scenes.patients.part_surfaces import PARTS
from scenes.patients.patient_folder import save_patient
from scenes.patients.patient_import import Patient, import_patient
from scenes.patients.patient_scene import patient_scene, stiffness_row
from scenes.patients.readers.label_maps import LabelMap
from scenes.patients.readers.segment_choice import assign_tissues
from scenes.scene import Scene, load_scene, scene_text, with_options
from scenes.surfaces import save_surface
from scenes.volumes.lazy_volume import LazyVolume
from ultrasound.coverage import GRID_POINTS, Coverage
from ultrasound.probe_manipulator import advanced, touching

SINUS = np.array([62.0, 35.0, 12.0]), np.array([13.0, 10.0, 22.0])
PELVIS = np.array([52.0, 35.0, 12.0]), np.array([16.0, 6.0, 12.0])  # in the sinus, and out of the kidney
VESSEL = np.array([45.0, 40.0, 12.0]), np.array([22.0, 4.0, 4.0])
CYST = np.array([70.0, 20.0, -18.0]), np.array([12.0, 12.0, 12.0])  # sticks out, as the tumour
NAMES = {3: "tumour", 4: "cyst", 5: "sinus", 6: "urine", 7: "vessel"}
MOST_FORCE_N = 1.0
pytestmark = pytest.mark.usefixtures("arrays_stored")


@pytest.fixture(scope="module")
def patient() -> Patient:
    """A left kidney with all that an import knows of."""
    ct, labels = body()
    solids = (1, RIGHT), (2, LEFT), (3, TUMOUR), (4, CYST), (5, SINUS), (6, PELVIS), (7, VESSEL)
    words = {tissue: [str(value)] for value, tissue in NAMES.items()}
    (labelled,) = assign_tissues([LabelMap.of(drawn(labels, *solids))], ["2", "5"], words)
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        return import_patient(LazyVolume.of(ct), labelled, [2, 5], margin_mm=20.0, assigned=words)


@pytest.fixture(scope="module")
def folder(patient, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("patients") / "a"
    save_patient(patient, folder)
    return folder


def scene_of(patient: Patient, folder: Path, *parts: str, **given) -> Scene:
    """The scene that an import of a patient with some of the parts writes, read again, coarse."""
    some = replace(patient, parts={name: surface for name, surface in patient.parts.items() if name in parts})
    path = folder / "scene.toml"
    path.write_text(scene_text(patient_scene(some, **given)))
    return with_options(load_scene(path), {"tissue.cell_mm": 7.0, "solver.iterations": 4})


def pressed(scene: Scene, folder: Path, depth_mm: float = 8.0) -> PressedOrgan:
    """The organ, settled and pressed."""
    press = scene.press.model_copy(update=dict(warm_up_steps=20))
    anatomy = load_anatomy(scene, folder)
    case = case_of(scene.model_copy(update=dict(press=press)), anatomy)
    organ = PressedOrgan(case)
    organ.settle()
    start = touching(case.press_pose, case.size_mm, np.asarray(case.organ.vertices))
    for depth in [*np.linspace(-2.0, depth_mm, 50), *[depth_mm] * 20]:
        organ.advance(advanced(start, depth))
        assert organ.notice == ""
    return organ


def assert_sound(organ: PressedOrgan) -> None:
    state = organ.body.snapshot()
    assert np.isfinite(state.position).all() and np.isfinite(state.velocity).all()
    # It lies on its support, and is not thrown.
    assert np.abs(state.position).max() < 150 and np.abs(state.velocity).max() < 100


@pytest.mark.parametrize(
    "parts",
    [
        ("vessel",),
        ("tumour",),
        ("cyst",),
        ("sinus", "urine"),
        ("tumour", "cyst", "sinus", "urine", "vessel"),
    ],
)
def test_every_combination_of_parts_is_pressed(device, patient, folder, parts):
    scene = scene_of(patient, folder, *parts)
    expected = {name for name in parts if name != "vessel"}
    assert set(scene.tissue.parts) == expected
    organ = pressed(scene, folder)
    assert organ.model.has_parts == bool(expected)
    assert_sound(organ)


def test_parts_have_typical_values_and_the_summary_names_them(patient, folder):
    scene = scene_of(patient, folder, *PARTS)
    typical = mechanical_properties().parts
    for name, material in scene.tissue.parts.items():
        for key in ("young_kpa", "poisson", "density_g_cm3"):
            assert getattr(material, key) == getattr(typical[name], key)[1]
    assert scene.tissue.parts["tumour"].young_kpa > 3 * scene.tissue.young_kpa
    word, text = stiffness_row(scene)
    assert word == "stiffness" and "--uniform" in text
    assert "parenchyma 15, tumour 60, cyst 0.3, collecting system 0.3, sinus 8 kPa" in text
    assert stiffness_row(scene_of(patient, folder)) == ("stiffness", "15 kPa everywhere")


def test_uniform_leaves_the_parts_out(patient, folder):
    scene = scene_of(patient, folder, *PARTS, uniform=True)
    assert scene.tissue.parts == {} and scene.anatomy.tumour == "tumour.stl" and scene.anatomy.parts
    assert stiffness_row(scene) == ("stiffness", "15 kPa everywhere")


def test_a_stiff_tumour_stays_higher_under_the_probe(device, patient, folder):
    height = {}
    for uniform in (True, False):
        organ = pressed(scene_of(patient, folder, "tumour", uniform=uniform), folder)
        rest, direction = patient.tumour.vertices - organ.case.origin, np.array(organ.case.press.direction)
        interpolation = organ.model.carrier.interpolation
        along = interpolation.carried(np.asarray(rest), organ.body.snapshot().position) @ direction
        height[uniform] = np.ptp(along)
    before = np.ptp(patient.tumour.vertices @ direction)
    assert height[True] < before - 1.5 and height[False] > height[True] + 0.4


def test_parts_smaller_than_an_element_do_no_harm(device, patient, folder):
    """A small cyst in the tumour, which has almost no shear stiffness."""
    speck = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    speck.apply_translation(TUMOUR[0] + [-4.0, 0.0, 0.0])
    save_surface(speck, folder / "cyst.stl")
    tiny = replace(patient, parts={**patient.parts, "cyst": speck})
    assert_sound(pressed(scene_of(tiny, folder, "tumour", "cyst"), folder))
    save_surface(patient.parts["cyst"], folder / "cyst.stl")


def test_shape_matching_has_no_parts(device, patient, folder):
    scene = with_options(
        scene_of(patient, folder, *PARTS), {"tissue.model": "shape-matching", "tissue.radius_mm": 4.5}
    )
    assert scene.tissue.model == "shape-matching" and not hasattr(scene.tissue, "parts")
    assert scene.image.outside == "fluid" and scene.press.target_mm is not None
    assert_sound(pressed(scene, folder, 3.0))


def opened(scene: Scene, folder: Path) -> Rehearsal:
    image = scene.image.model_copy(update=dict(pixels=64))
    press = scene.press.model_copy(update=dict(warm_up_steps=60))
    anatomy = load_anatomy(scene, folder)
    return Rehearsal(case_of(scene.model_copy(update=dict(image=image, press=press)), anatomy), anatomy)


@pytest.mark.parametrize("parts", [("tumour",), ()])
def test_it_opens_in_contact_with_a_picture(device, patient, folder, parts):
    rehearsal = opened(scene_of(patient, folder, *parts), folder)
    anatomy, probe = rehearsal.anatomy, rehearsal.case.probe
    assert "Drop-in" in probe.transducer_name
    frame = rehearsal.do(Move(pose=rehearsal.scripted_pose(0.0)))
    look = anatomy.image_plane(), probe, "b-mode", "speckle", 350.0, 40.0
    image = anatomy.scanner.images(*look).by_name
    assert touched_share(anatomy) > 0.8
    measurements = LiveMeasurements(anatomy, rehearsal.manipulator)
    measurements.observe(frame, probe)
    assert measurements.latest.contact_mm2 > 2 and measurements.latest.force_n <= MOST_FORCE_N
    assert (image["B-mode"] > 12).mean() > 0.5
    frame = rehearsal.do(*[Move(pose=rehearsal.manipulator.pose())] * 20)
    assert np.linalg.norm(frame.wrench[:3]) <= MOST_FORCE_N


def touched_share(anatomy: DeformedAnatomy) -> float:
    """The share of the scanlines in contact."""
    case = anatomy.case
    rest = anatomy.scanner.plane.rest_grid(GRID_POINTS)
    return Coverage(case.organ, None).add(rest, case.probe, case.scene.image.coupling_gap_mm).mean()
