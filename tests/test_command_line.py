"""What commands share."""

from pathlib import Path

import pytest

from scenes.scene import EMBEDDED
from studies.command_line import Fault, load_patient, save_figures


def test_a_folder_stands_for_its_scene(tmp_path):
    (tmp_path / "scene.toml").write_text(Path(EMBEDDED).read_text("utf-8"), "utf-8")
    scene, anatomy = load_patient(tmp_path)
    assert scene.anatomy.phantom and anatomy.organ.is_watertight and anatomy.tumour.is_watertight


def test_figures_that_cannot_be_written_say_so(tmp_path, capsys):
    save_figures({"mm": 1.0}, tmp_path / "a.json")
    assert (tmp_path / "a.json").is_file() and "Wrote" in capsys.readouterr().out
    with pytest.raises(Fault, match=r"cannot be written \(.*\); choose another --json"):
        save_figures({"mm": 1.0}, tmp_path / "none" / "a.json")
