"""Loading a scene imports neither the importer nor the embedded patient's generator."""

import subprocess
import sys

import pytest
import trimesh
from conftest import ROOT

from scenes import anatomy
from scenes.anatomy import Grid, fingerprint, load_anatomy
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import EMBEDDED, load_scene
from scenes.volumes.volume_files import file_volume

LOAD = """
import sys
from pathlib import Path
from scenes.anatomy import load_anatomy
from scenes.scene import load_scene, scene_file
path = scene_file(Path(sys.argv[1]))
print(load_anatomy(load_scene(path), path.parent).organ.is_watertight)
print([name for name in sys.modules if name.startswith(("scenes.patients", "scenes.phantom."))])
"""


@pytest.mark.parametrize("embedded", [True, False], ids=["embedded patient", "patient's folder"])
def test_loading_a_scene_imports_no_importer_and_no_generator(embedded):
    folder = phantom_folder()  # an imported patient's folder like any other
    command = [sys.executable, "-c", LOAD, EMBEDDED if embedded else folder]
    found = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    assert found == ["True", "['scenes.phantom.embedded_patient']"]


def test_each_volume_is_read_once(monkeypatch):
    read = []
    monkeypatch.setattr(anatomy, "file_volume", lambda path: (read.append(path.name), file_volume(path))[1])
    load_anatomy(load_scene(EMBEDDED), EMBEDDED.parent)
    assert sorted(read) == ["ct.nrrd", "labels.nrrd"]


def test_the_embedded_patient_is_a_patients_folder():
    embedded = load_anatomy(load_scene(EMBEDDED), EMBEDDED.parent)
    folder = phantom_folder()
    assert fingerprint(embedded) == fingerprint(load_anatomy(load_scene(folder / "scene.toml"), folder))
    assert set(embedded.parts) == {"urine", "vessel", "sinus"} and isinstance(embedded.ct, Grid)
    assert isinstance(embedded.shapes[0], trimesh.Trimesh)
    assert embedded.tissues[1] == "kidney" and embedded.tissues[2] == "tumour"
