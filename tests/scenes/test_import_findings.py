"""The findings of an import in the patient's folder, and the warnings that stay until they are
acknowledged.
"""

import json

import numpy as np
import pytest
from ball_patient import folder_of_ball
from conftest import rotation_about

from app import main
from scenes.import_findings import (
    acknowledge,
    acknowledged_warnings,
    import_remarks,
    open_warnings,
    read_findings,
    side_of,
    warning_lines,
)
from scenes.patients.patient_findings import _grid
from scenes.scene import AnatomyFiles, Scene, SceneError
from scenes.volumes.voxel_grid import VoxelGrid

TEXTS = ("the rim is fat", "two of <three> lines")


def findings(*acknowledged: bool) -> dict:
    grid = dict(
        size=[2, 3, 4], spacing_mm=[1, 1, 2], origin_mm=[0, 0, 0], direction=np.eye(3, dtype=int).tolist()
    )
    warnings = [dict(text=text, acknowledged=done) for text, done in zip(TEXTS, acknowledged, strict=False)]
    return dict(
        version="2.0",
        side="left",
        draft=False,
        position="supine",
        extent_mm=[50, 50, 100],
        surfaces=dict(organ=dict(faces=500, volume_ml=150.0, label_ml=151.0)),
        series="3",
        source=grid,
        ct=grid,
        tissues={"1": "kidney"},
        complexity=None,
        warnings=warnings,
        notes=["a note"],
    )


@pytest.fixture
def folder(tmp_path):
    made = folder_of_ball(tmp_path)
    (made / "import.json").write_text(json.dumps(findings(False, False)))
    return made


def files_scene() -> Scene:
    return Scene(anatomy=AnatomyFiles())


def test_a_place_of_a_grid_follows_from_its_findings():
    """Of an oblique grid, as SimpleITK has it."""
    turn = rotation_about([3, 1, 2], 50)
    grid = VoxelGrid((9, 8, 7), np.array([0.7, 1.1, 5.0]), np.array([12.5, -80.25, 900.0]), turn)
    found = _grid(grid)
    index = 3, 5, 6
    place = np.array(found.direction) @ (np.array(found.spacing_mm) * index) + found.origin_mm
    expected = grid.image(np.zeros((7, 8, 9), np.uint8)).TransformIndexToPhysicalPoint(index)
    # Four digits of each.
    assert found.size == (9, 8, 7) and place == pytest.approx(expected, abs=5e-5 * (1 + 3 * 30))


def test_warnings_are_open_until_they_are_acknowledged(folder):
    assert open_warnings(files_scene(), folder) == TEXTS
    assert open_warnings(Scene(anatomy=AnatomyFiles(phantom=True)), folder) == ()
    assert acknowledged_warnings(files_scene(), folder) == ()
    before = read_findings(folder)
    acknowledge(folder, TEXTS)
    assert open_warnings(files_scene(), folder) == ()
    assert acknowledged_warnings(files_scene(), folder) == TEXTS
    after = read_findings(folder)
    # Nothing else has changed, and no other file is left.
    assert [each.text for each in after.warnings] == list(TEXTS)
    assert after.model_copy(update=dict(warnings=before.warnings)) == before
    assert not list(folder.glob(".*"))


def test_others_read_of_all_warnings_and_of_a_draft(folder, tmp_path):
    acknowledge(folder, TEXTS[:1])
    start = "Warning of the import,"
    not_checked = [f"{start} not acknowledged: {text}" for text in TEXTS[1:]]
    assert import_remarks(files_scene(), folder) == [*not_checked, f"{start} acknowledged: {TEXTS[0]}"]
    (folder / "import.json").write_text(json.dumps(findings() | dict(draft=True)))
    assert import_remarks(files_scene(), folder)[0].startswith("Draft segmentation")
    assert import_remarks(Scene(anatomy=AnatomyFiles(phantom=True)), folder) == []
    assert import_remarks(files_scene(), tmp_path / "none") == []


def test_a_warning_that_was_not_shown_stays_open(folder):
    acknowledge(folder, ["another import's", TEXTS[0]])
    acknowledge(folder, [])
    assert open_warnings(files_scene(), folder) == TEXTS[1:]


def test_the_side_is_that_of_the_import(folder, tmp_path):
    assert side_of(files_scene(), folder) == "left"
    path = folder / "import.json"
    path.write_text(path.read_text().replace('"left"', '"right"'))
    assert side_of(files_scene(), folder) == "right"
    # Where no import has stated it.
    assert side_of(files_scene(), tmp_path / "other") is None
    assert side_of(Scene(anatomy=AnatomyFiles(phantom=True)), tmp_path) == "left"


def test_a_folder_without_findings_has_no_warnings(tmp_path):
    assert read_findings(tmp_path) is None and open_warnings(files_scene(), tmp_path) == ()
    acknowledge(tmp_path, TEXTS)
    assert warning_lines((), tmp_path) == [] and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "invalid JSON"),
        ("[]", "expected the findings"),
        (json.dumps(findings() | dict(side="top")), "side = 'top'"),
        (json.dumps(findings() | dict(patient="Doe")), "patient"),
    ],
)
def test_damaged_findings_are_named(folder, content, words):
    (folder / "import.json").write_text(content)
    with pytest.raises(SceneError, match=r"import\.json: .*import the patient again") as caught:
        read_findings(folder)
    assert words.lower() in str(caught.value).lower()


def test_the_command_asks_and_then_they_are_gone(folder, capfd, monkeypatch):
    monkeypatch.setattr("sys.stdin", open("/dev/null"))  # noqa: SIM115
    assert main(["acknowledge", str(folder)]) == 2
    printed, refused = capfd.readouterr()
    assert all(f"WARNING of the import: {text}" in printed for text in TEXTS)
    assert "check.png" in refused and refused.endswith(f"acknowledge {folder} --yes\n")
    assert open_warnings(files_scene(), folder) == TEXTS
    assert main(["acknowledge", str(folder), "--yes"]) == 0
    assert open_warnings(files_scene(), folder) == ()
    assert main(["acknowledge", str(folder)]) == 0 and "no warning" in capfd.readouterr().out


def test_the_command_needs_an_imported_patient(folder, capfd):
    (folder / "import.json").unlink()
    assert main(["acknowledge", str(folder)]) == 2
    assert "has no import.json" in capfd.readouterr().err


def test_commands_that_use_the_patient_repeat_them(folder, tmp_path, capfd):
    assert main(["export", str(folder), "--out", str(tmp_path / "out")]) == 0
    printed = capfd.readouterr().out
    assert f"WARNING of the import: {TEXTS[0]}\n" in printed and f"acknowledge {folder}" in printed
    acknowledge(folder, TEXTS)
    assert main(["export", str(folder), "--out", str(tmp_path / "again")]) == 0
    assert "WARNING" not in capfd.readouterr().out
