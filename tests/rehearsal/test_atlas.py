"""The switch of what is drawn from an atlas: from a scene or an option to the tissue of every voxel."""

import json

import numpy as np
import pytest
import trimesh
from conftest import ROOT

from app import main
from rehearsal import deformed_anatomy, pose_scans
from rehearsal.case import case_of
from rehearsal.deformed_anatomy import scanned_anatomy, scanned_ct
from rehearsal.sessions.session_file import Header, recorded_values, scene_of_log
from scenes.anatomy import Grid, LoadedAnatomy, load_anatomy
from scenes.scene import EMBEDDED, SceneError, load_scene, scene_text, with_options

pytestmark = pytest.mark.usefixtures("arrays_stored")

KIDNEY_HU, FAT_HU = 35.0, -100.0


@pytest.fixture(scope="module")
def anatomy() -> LoadedAnatomy:
    """An unenhanced kidney in fat, an ellipsoid of 44 x 36 x 64 mm, on voxels of 1.5 mm."""
    axes, middle = np.array([22.0, 18.0, 32.0]), np.full(3, 50.0)
    ball = trimesh.creation.icosphere(subdivisions=3)
    organ = trimesh.Trimesh(ball.vertices * axes + middle, ball.faces)
    places = np.moveaxis(np.indices((67, 67, 67)), 0, -1) * 1.5
    kidney = np.linalg.norm((places - middle) / axes, axis=-1) < 1
    index_from_mm = np.diag([1 / 1.5, 1 / 1.5, 1 / 1.5, 1.0])
    ct, labels = (
        Grid(np.asarray(each, np.float32), index_from_mm)
        for each in (np.where(kidney, KIDNEY_HU, FAT_HU), kidney)
    )
    return LoadedAnatomy(organ, None, ct, (), labels, {1: "kidney"})


@pytest.mark.parametrize(("draws", "tissues"), [(False, {"kidney"}), (True, {"cortex", "medulla"})])
def test_pyramids_are_drawn_where_it_is_on(anatomy, draws, tissues):
    scanned = scanned_anatomy(anatomy.organ, anatomy.ct, anatomy, np.zeros(3), draws)
    found = scanned.classify()
    inside = anatomy.labels.voxels > 0
    names = {found.tissues[code] for code in np.unique(found.labels[inside]) if code}
    assert tissues <= names and not names & ({"kidney", "cortex", "medulla"} - tissues)


class Seen(Exception):
    """What a scanner is asked to draw."""


@pytest.fixture
def asked(monkeypatch):
    """Where a scanner would be built, its switch is raised instead."""

    def seen(organ, ct, anatomy, origin, draws):
        raise Seen(draws)

    for module in (pose_scans, deformed_anatomy):
        monkeypatch.setattr(module, "scanned_anatomy", seen)


@pytest.mark.parametrize("is_on", [True, False])
def test_a_rehearsal_asks_for_what_its_scene_says(asked, is_on):
    scene = with_options(load_scene(EMBEDDED), {"image.atlas": is_on})
    anatomy = load_anatomy(scene, EMBEDDED.parent)
    with pytest.raises(Seen) as error:
        scanned_ct(case_of(scene, anatomy), anatomy)
    assert error.value.args == (is_on,)


@pytest.mark.parametrize(
    ("options", "is_on"), [([], True), (["--no-atlas"], False), (["--no-atlas", "--atlas"], True)]
)
def test_a_scan_asks_for_what_its_option_says(asked, tmp_path, options, is_on):
    with pytest.raises(Seen) as error:
        main(
            ["scan", str(EMBEDDED), "--pose", str(ROOT / "docs/poses.json"), "--out", str(tmp_path), *options]
        )
    assert error.value.args == (is_on,)


def test_it_is_recorded_and_replayed():
    scene = with_options(load_scene(EMBEDDED), {"image.atlas": False})
    recorded = json.loads(json.dumps(recorded_values(scene)))
    assert recorded["image"]["atlas"] is False
    header = Header(anatomy="", scene=recorded, probe={}, arch="cpu", time_step_s=0.02)
    assert not scene_of_log(header, load_scene(EMBEDDED)).image.atlas


def test_a_scene_has_it_and_other_words_are_refused(tmp_path):
    assert "atlas = true" in scene_text(load_scene(EMBEDDED))
    (tmp_path / "scene.toml").write_text("[anatomy]\nphantom = true\n[image]\natlas = 'no'\n")
    with pytest.raises(SceneError, match=r"image\.atlas"):
        load_scene(tmp_path / "scene.toml")
