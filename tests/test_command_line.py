"""What commands share."""

from pathlib import Path

import pytest

from scenes.scene import EMBEDDED
from studies.command_line import Fault, load_patient, probe_named, save_figures, scene_file


def test_a_folder_stands_for_its_scene(tmp_path):
    with pytest.raises(Fault, match="holds no scene.toml"):
        scene_file(tmp_path)
    (tmp_path / "scene.toml").write_text(Path(EMBEDDED).read_text("utf-8"), "utf-8")
    assert scene_file(tmp_path) == scene_file(tmp_path / "scene.toml") == tmp_path / "scene.toml"
    assert scene_file(tmp_path / "none.toml") == tmp_path / "none.toml"
    scene, anatomy = load_patient(tmp_path)
    assert scene.anatomy.phantom and anatomy.organ.is_watertight and anatomy.tumour is not None


def test_a_probes_file_is_found_from_any_folder_and_a_name_stays_one(tmp_path, monkeypatch):
    (tmp_path / "own.toml").touch()
    monkeypatch.chdir(tmp_path)
    assert probe_named("own.toml") == str((tmp_path / "own.toml").resolve())
    assert [probe_named(probe) for probe in ("linear", None)] == ["linear", None]


def test_figures_that_cannot_be_written_say_so(tmp_path, capsys):
    save_figures({"mm": 1.0}, tmp_path / "a.json")
    assert (tmp_path / "a.json").is_file() and "Wrote" in capsys.readouterr().out
    with pytest.raises(Fault, match=r"cannot be written \(.*\); choose another --json"):
        save_figures({"mm": 1.0}, tmp_path / "none" / "a.json")
