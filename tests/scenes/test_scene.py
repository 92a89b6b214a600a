"""Scene files: what is refused, in which words, and what they load."""

import re
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh

from errors import PatientError
from rehearsal.build_solver import step_settings
from rehearsal.configuration import probe_of
from scenes.anatomy import load_anatomy, press_on
from scenes.scene import (
    EMBEDDED,
    AnatomyFiles,
    Image,
    Press,
    Scene,
    SceneError,
    SolverSection,
    Transducer,
    load_scene,
    scene_file,
    scene_text,
    with_options,
)
from scenes.tissue import NeoHookeanTissue, ShapeMatchingTissue
from ultrasound.probe import ProbeError


def refused(tmp_path: Path, text: str) -> str:
    path = tmp_path / "a.toml"
    path.write_text(text, "utf-8")
    with pytest.raises(SceneError) as error:
        load_scene(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    return str(error.value)


PLANE = "[[shape]]\nkind = 'plane'\nnormal = [0, 0, 1]\noffset_mm = 1\n"


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "anatomy: missing"),
        (
            "[anatomy]\n[tissue]\nradius_cm = 0.27",
            "tissue.radius_cm: unknown key; the unit is in the key: write radius_mm",
        ),
        (
            "[anatomy]\n[tissue]\nradius = 2.7",
            "tissue.radius: unknown key; the unit is in the key: write radius_mm",
        ),
        (
            "[anatomy]\n[solver]\ntime_step_ms = 16",
            "solver.time_step_ms: unknown key; the unit is in the key: write time_step_s",
        ),
        ("[anatomy]\n[gravity]\nacceleration_mm_s2 = 9810", "write acceleration_m_s2"),
        ("[anatomy]\n[tissue]\nstifness = 1", "tissue.stifness: unknown key; did you mean stiffness?"),
        (
            "[anatomy]\n[tissue]\nmodel = 'shape-matching'\nstiffness = 2",
            "tissue.stiffness = 2: input should be less than or equal to 1",
        ),
        (
            "[anatomy]\n[tissue]\nmodel = 'shape-matching'\nradius_mm = '2.7 mm'",
            "tissue.radius_mm = '2.7 mm': input should be a valid number",
        ),
        ("[anatomy]\n[tissue]\ncell_mm = nan", "tissue.cell_mm"),
        ("[anatomy]\n[tissue]\nstiffness = 1", "belongs to the tissue model shape-matching"),
        (
            "[anatomy]\n[tissue]\nmodel = 'mass-springs'",
            "tissue.model = 'mass-springs': the model should be one of",
        ),
        (
            "[anatomy]\n[transducer]\nsize_mm = [40.0, 10.0, 151.0]",
            "transducer.size_mm.2 = 151.0: input should be less than or equal to 150",
        ),
        ("[anatomy]\n[tissue]\ncell_mm = 0x" + "f" * 5000, "tissue.cell_mm = a number with many digits"),
        ("tissue = 3\n[anatomy]", "tissue = 3: expected a table of keys and values"),
        ("[anatomy]\n[tissue]\nmodel = [3]", "tissue.model = [3]: the model should be one of"),
        ("[anatomy]\n[contact]\nparticles = true", "needs particles: set tissue.model to shape-matching, or"),
        ("[anatomy]\n[gravity]\ndirection = [0, 0, 0]", "a direction must not be zero"),
        (
            "[anatomy]\n[[shape]]\nkind = 'plane'\nnormal = [0, 0, 1]\noffset_cm = 1",
            "shape.0.offset_cm: unknown key; the unit is in the key: write offset_mm",
        ),
        ("[anatomy]\n[attachment]\nradius_mm = 5", "a.toml: attachment.radius_mm needs a position"),
        ("[anatomy]\n[attachment]\nat_mm = [0,0,0]\nstiffness_n_mm = 5", "needs the tissue that it holds"),
        ("[anatomy]\n[attachment]\nfat_kpa = 5", "the unit is in the key: write fat_kpa_mm"),
        ("[anatomy]\n[tissue.parts.tumour]", "tissue.parts.tumour needs a surface: give anatomy.tumour"),
        ("[anatomy]\n[tissue.parts.cyst]", "tissue.parts.cyst needs a surface: give anatomy.parts.cyst"),
        ("[anatomy]\n[tissue.parts.spleen]", "spleen"),
        ("[anatomy]\n[tissue]\ncapsule_n = 1", "the unit is in the key: write capsule_n_mm"),
        ("[anatomy]\n[[tissue.prony]]\nmodulus_ratio = 1", "tissue.prony.0.time_s: missing"),
        (
            "[anatomy]\ntumour = 't.stl'\n[tissue.parts.tumour]\npoisson = 0.5",
            "tissue.parts.tumour.poisson = 0.5: input should be less than or equal to 0.4999",
        ),
        ("[anatomy]\n[tissue]\nyoung_kpa = '15'", "tissue.young_kpa = '15': input should be a valid number"),
        ("[anatomy]\n[solver]\niterations = '4'", "solver.iterations = '4': input should be a valid integer"),
        (
            "[anatomy]\n[contact]\nparticles = 'yes'",
            "contact.particles = 'yes': input should be a valid boolean",
        ),
        ("[anatomy]\n[trocar]\nat_mm = [0, '1', 2]", "trocar.at_mm.1 = '1': input should be a valid number"),
        (
            "[anatomy]\n[[tissue.prony]]\nmodulus_ratio = true\ntime_s = 1",
            "prony.0.modulus_ratio = True: input",
        ),
        ("[anatomy]\n[[shape]]\nkind = 'ball'", "'plane', 'mesh', 'sdf'"),
        ("[anatomy]\n" + PLANE * 31, "at most 30 items"),
        ("[anatomy]\n[organs]\n", "organs: unknown key"),
        (
            "[anatomy]\nphantm = 1\n[tissue]\nyoung_kpa = 0\npoison = 0",
            "(and 2 more: tissue.poison, tissue.young_kpa)",
        ),
        ("nephron_scene = 3\n[brain]\n", "nephron_scene = 3: written by Nephron 3, and this is Nephron 2"),
        ("nephron_scene = 'two'\n[anatomy]\n", "nephron_scene = 'two': expected 2"),
        ("[anatomy\n", "; expected a scene file (TOML in UTF-8) or a patient's folder"),
        ("[anatomy]\nphantom = true\nct = 'ct.nrrd'", "which has its own files"),
        ("[anatomy]\n[press]\nindentations_mm = [300.0]", "less than or equal to 40"),
    ],
)
def test_a_wrong_scene_is_refused_by_name(tmp_path, text, words):
    assert words in refused(tmp_path, text)


def test_missing_and_unreadable_files_are_named(tmp_path):
    with pytest.raises(SceneError, match="no such scene file"):
        load_scene(tmp_path / "none.toml")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match="not text in UTF-8.; expected a scene file .TOML in UTF-8"):
        load_scene(tmp_path / "b.toml")
    with pytest.raises(SceneError, match="cannot be read"):
        load_scene(tmp_path)


def test_a_scene_written_is_the_scene_read(tmp_path):
    changes = {"tissue.cell_mm": 3.0, "tissue.young_kpa": None}
    scene = with_options(load_scene(EMBEDDED), changes)
    (tmp_path / "a.toml").write_text(scene_text(scene), "utf-8")
    assert load_scene(tmp_path / "a.toml") == scene
    assert scene.tissue.cell_mm == 3.0
    other = with_options(scene, {"tissue.model": "shape-matching", "tissue.radius_mm": 3.3})
    assert (other.tissue.radius_mm, other.tissue.stiffness) == (3.3, 0.95)


def test_options_out_of_range_are_refused():
    with pytest.raises(SceneError, match=r"^--poisson = 0.5: input should be"):
        with_options(load_scene(EMBEDDED), {"tissue.poisson": 0.5})
    both = {"tissue.radius_mm": 3.0, "tissue.cell_mm": 4.0}
    with pytest.raises(SceneError, match=r"^--radius: belongs to the tissue model shape-matching"):
        with_options(load_scene(EMBEDDED), both)


def test_a_value_that_one_model_has_asks_for_that_model():
    scene = load_scene(EMBEDDED)
    assert with_options(scene, {"tissue.radius_mm": 3.0}).tissue.radius_mm == 3.0
    assert with_options(scene, {"tissue.cell_mm": 3.0}).tissue.model == "neo-hookean"
    paper = with_options(scene, {"tissue.model": "shape-matching"})
    assert with_options(paper, {"tissue.density_g_cm3": 1.0}).tissue.model == "shape-matching"
    assert (
        with_options(paper, {"tissue.young_kpa": 9.0}).tissue
        == with_options(scene, {"tissue.young_kpa": 9.0}).tissue
    )


def test_shape_matchings_defaults_are_the_papers_table_1():
    scene = Scene(anatomy=AnatomyFiles(), tissue=ShapeMatchingTissue(model="shape-matching"))
    contact, tissue = scene.contact, scene.tissue
    step = step_settings(tissue, scene.solver)
    assert (step.time_step_s, step.substeps, step.iterations) == (1 / 60, 3, 9)
    assert (scene.solver.relaxation, step.relaxation_factor, step.damping) == ("local", 1.0, 12.0)
    assert (tissue.cluster_spacing, tissue.volume_sampling, tissue.density_g_cm3) == (3.33, 4.0, 1.05)
    assert (contact.shape_friction, contact.particle_friction) == (0.35, 0.25)
    assert scene.gravity.acceleration_m_s2 == 9.81


def test_a_step_is_as_the_scene_says_then_as_its_tissue_does_then_the_papers():
    soft = ShapeMatchingTissue(model="shape-matching", stiffness=0.5)
    step = step_settings(soft, SolverSection(iterations=5))
    assert (step.stiffness, step.iterations, step.substeps) == (0.5, 5, 3)
    step = step_settings(NeoHookeanTissue(), SolverSection(iterations=5))
    assert (step.iterations, step.substeps, step.relaxation_factor) == (5, 1, 1.7)


def with_ball(folder: Path, **changes) -> Scene:
    trimesh.creation.icosphere(subdivisions=2, radius=10.0).export(folder / "organ.stl")
    return Scene(anatomy=AnatomyFiles(), **changes)


def test_files_that_a_scene_names_are_checked(tmp_path):
    scene = with_ball(tmp_path)
    assert load_anatomy(scene, tmp_path).organ.is_watertight
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "organ.stl")
    with pytest.raises(PatientError, match="organ.stl: is not a closed surface"):
        load_anatomy(scene, tmp_path)
    (tmp_path / "organ.stl").write_text("solid nothing")
    with pytest.raises(PatientError, match="organ.stl"):
        load_anatomy(scene, tmp_path)
    (tmp_path / "organ.stl").unlink()
    with pytest.raises(PatientError, match="organ.stl: no such surface file"):
        load_anatomy(scene, tmp_path)
    with_ball(tmp_path)
    with pytest.raises(SceneError, match="ct.nrrd: no such file"):
        load_anatomy(Scene(anatomy=AnatomyFiles(ct="ct.nrrd")), tmp_path)


def test_a_ct_keeps_its_place_in_the_patient(tmp_path):
    image = sitk.GetImageFromArray(np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6))
    image.SetSpacing((0.5, 1.0, 2.0))
    image.SetOrigin((10.0, -20.0, 30.0))
    image.SetDirection((-1, 0, 0, 0, -1, 0, 0, 0, 1))
    sitk.WriteImage(image, str(tmp_path / "ct.nrrd"))
    with_ball(tmp_path)
    ct = load_anatomy(Scene(anatomy=AnatomyFiles(ct="ct.nrrd")), tmp_path).ct
    point = np.array([*image.TransformIndexToPhysicalPoint((3, 4, 2)), 1.0])
    assert ct.index_from_mm @ point == pytest.approx([3, 4, 2, 1])
    assert ct.voxels[3, 4, 2] == image[3, 4, 2]


def test_an_oblique_distance_field_is_refused(tmp_path):
    image = sitk.Image(4, 4, 4, sitk.sitkFloat32)
    image.SetDirection((-1, 0, 0, 0, -1, 0, 0, 0, 1))
    sitk.WriteImage(image, str(tmp_path / "bed.nrrd"))
    scene = with_ball(tmp_path, shape=({"kind": "sdf", "file": "bed.nrrd"},))
    with pytest.raises(SceneError, match="bed.nrrd.*identity as direction"):
        load_anatomy(scene, tmp_path)


def test_a_press_left_open_goes_with_gravity_through_the_tumour(tmp_path):
    anatomy = load_anatomy(with_ball(tmp_path), tmp_path)
    press = press_on(Press(), anatomy, np.array([0.0, 1.0, 0.0]))
    assert press.target_mm == pytest.approx((0, 0, 0), abs=1e-6)
    assert press.direction == (0.0, 1.0, 0.0)
    # With what the organ's own weight adds.
    assert max(press.indentations_mm) + 1 < Transducer().compression_warning_mm
    given = Press(target_mm=(1, 2, 3), direction=(0, 0, -2), lateral=(1, 0, 0))
    kept = press_on(given, anatomy, np.array([0.0, 1.0, 0.0]))
    assert kept.target_mm == (1, 2, 3) and kept.direction == (0, 0, -1) and kept.lateral == (1, 0, 0)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.PNG", "is a picture; expected a scene file"),
        ("ct.nii.gz", "app.py import"),
        ("sweep-001.igs.mha", "a tracked sweep: give it to app.py reconstruct"),
        ("sweep-001.igs.nrrd", "a tracked sweep: give it to app.py reconstruct"),
        ("session-001.jsonl", "a session: give it to rehearse --replay"),
        ("plan.json", "rehearse --plan"),
    ],
)
def test_what_is_no_scene_is_named_with_what_takes_it(tmp_path, name, words):
    (tmp_path / name).write_bytes(b"\x89 anything")
    with pytest.raises(SceneError, match=words):
        load_scene(tmp_path / name)
    (tmp_path / "session-001.jsonl").touch()
    with pytest.raises(
        SceneError, match="contains session-001.jsonl, a session: give that file to rehearse --replay"
    ):
        scene_file(tmp_path)


def test_a_folder_is_its_scene_and_without_one_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"has no scene\.toml; make"):
        scene_file(tmp_path)
    (tmp_path / "scene.toml").write_text("")
    assert scene_file(tmp_path) == scene_file(tmp_path / "scene.toml") == tmp_path / "scene.toml"


def test_a_probes_file_is_named_from_where_the_program_was_started(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text("")
    probes = [
        with_options(load_scene(EMBEDDED), {"transducer.probe": name}).transducer.probe
        for name in ("mine.toml", "linear")
    ]
    assert probes == [str((tmp_path / "mine.toml").resolve()), "linear"]


def test_a_scenes_probes_file_lies_beside_it(tmp_path, monkeypatch):
    """Wherever the program is started, and whoever asks for the probe."""
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "mine.toml").write_text('TransducerName = "mine"')
    (tmp_path / "mine.toml").write_text('TransducerName = "another"')
    (tmp_path / "scenes" / "a.toml").write_text('[anatomy]\n[transducer]\nprobe = "mine.toml"')
    monkeypatch.chdir(tmp_path)
    scene = load_scene(Path("scenes/a.toml"))
    monkeypatch.chdir(tmp_path.parent)
    assert probe_of(with_options(scene, {"tissue.cell_mm": 5.0})).transducer_name == "mine"
    (tmp_path / "scenes" / "mine.toml").unlink()
    with pytest.raises(ProbeError, match="scenes.*mine.toml' is no file, and known by name are"):
        probe_of(scene)


@pytest.mark.parametrize(
    "size_mm, depth_mm, words",
    [
        (
            (42.0, 3.0, 20.0),
            None,
            r"^transducer.size_mm = \[42.0, 3.0, 20.0\] does not fit the probe Drop-in.*EdgeRadiusMm = 2",
        ),
        (
            (12.0, 9.0, 6.0),
            50.0,
            r"image.depth_mm = 50.0.*FinMm is 18 x 2 mm across, expected at most the 12",
        ),
        ((30.0, 9.0, 6.0), 50.0, r"image.depth_mm = 50.0.*the array is 35.8 mm wide, HousingMm 30"),
    ],
)
def test_a_size_that_does_not_fit_the_probe_is_refused(size_mm, depth_mm, words):
    scene = load_scene(EMBEDDED)
    changed = scene.model_copy(
        update=dict(transducer=Transducer(probe="drop-in", size_mm=size_mm), image=Image(depth_mm=depth_mm))
    )
    with pytest.raises(ProbeError, match=words):
        probe_of(changed)
    fits = scene.model_copy(update=dict(transducer=Transducer(probe="drop-in", size_mm=(38.0, 10.0, 22.0))))
    assert probe_of(fits).housing_mm == (38.0, 10.0, 22.0)


def test_fluid_couples_as_far_as_it_reaches():
    dry, wet = Image(), Image(outside="fluid")
    assert dry.coupling_gap_mm == dry.contact_gap_mm == 1.5 and wet.coupling_gap_mm == wet.fluid_gap_mm == 8.0
    assert Image(outside="fluid", fluid_gap_mm=0.5).coupling_gap_mm == 1.5
    assert Image(fluid_gap_mm=3.0).coupling_gap_mm == 1.5


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ('outside = "fluid"\ncontact = "tissue"', 'image.contact is "tissue": set it to "organ"'),
        ('outside = "water"', "image.outside"),
        ('outside = "fluid"\nfluid_gap_mm = 11.0', "image.fluid_gap_mm"),
        ('outside = "fluid"\nfluid_gap_mm = -1.0', "image.fluid_gap_mm"),
    ],
)
def test_fluid_that_cannot_be_is_refused(tmp_path, values, words):
    (tmp_path / "scene.toml").write_text(f"[anatomy]\n[image]\n{values}\n")
    with pytest.raises(SceneError, match=re.escape(words)):
        load_scene(tmp_path / "scene.toml")
