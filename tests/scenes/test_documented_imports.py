"""Every command line of the documents that imports is run, on data made for it."""

import re
import shlex
import shutil

import numpy as np
import pytest
import SimpleITK as sitk
from conftest import ROOT
from synthetic_body import BODY, LEFT, RIGHT, TUMOUR, coarsely, drawn, grid_around, without_picture

from app import main
from scenes.import_findings import read_findings

# So that the seed of the documents is in the left kidney.
SHIFT = np.array([-8.0, -4.0, -130.0])
# Muscle under both kidneys, and a bright part of the left.
MUSCLE = np.array([0.0, 75.0, 0.0]), np.array([120.0, 25.0, 300.0])
BRIGHT = np.array([62.0, 35.0, 12.0]), np.array([7.0, 7.0, 9.0])
PLACEHOLDERS = {"CT": "ct", "LABELS": "segmentations"}


def documented_imports() -> list[str]:
    """Arguments of app.py, each once."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    commands = re.compile(r"python app\.py (import [^`\n]*)")
    lines = [line for page in pages for line in commands.findall(page.read_text("utf-8"))]
    return list(dict.fromkeys(re.split(r"\s+#", line)[0].strip() for line in lines))


def virtual_tumour() -> str:
    """The code of the documents that writes tumour.stl."""
    page = (ROOT / "docs" / "patients.md").read_text("utf-8")
    return re.search(r'python -c "(import trimesh;[^"]*)"', page)[1]


@pytest.fixture(scope="module")
def clinic(tmp_path_factory):
    """A folder with all that the documents name."""
    folder = tmp_path_factory.mktemp("clinic")
    (folder / "ct").mkdir()
    (folder / "segmentations").mkdir()
    empty = grid_around((-175, -120, -60), (175, 120, 70), (3.4, 3.4, 3.4))
    ct = drawn(empty, (-90, BODY), (60, MUSCLE), (120, LEFT), (120, RIGHT), (70, TUMOUR), (260, BRIGHT))
    for name in ("ct.nii.gz", "ct/ct.nii.gz"):
        write(ct, folder / name)
    write(drawn(empty, (1, LEFT), (1, RIGHT), (2, TUMOUR)), folder / "kidneys.nii.gz")
    write(drawn(empty, (1, LEFT), (1, RIGHT), (2, TUMOUR), (3, BRIGHT)), folder / "labels.nii.gz")
    for name, solid in dict(
        kidney_left=LEFT, kidney_right=RIGHT, tumour=TUMOUR, autochthon_left=MUSCLE
    ).items():
        write(drawn(empty, (1, solid)), folder / "segmentations" / f"{name}.nii.gz")
    with pytest.MonkeyPatch.context() as patch:
        coarsely(patch)
        without_picture(patch)
        patch.chdir(folder)
        exec(virtual_tumour())
        assert main([*words_of("import ct kidneys.nii.gz --organ 1,2 --side left"), "--out", "bed"]) == 0
        shutil.copy(folder / "bed" / "support.stl", folder / "bed.stl")
        assert main(["export", "bed", "--out", "DIR"]) == 0
        yield folder


def write(image, path):
    image.SetOrigin((np.array(image.GetOrigin()) + SHIFT).tolist())
    sitk.WriteImage(image, str(path))
    image.SetOrigin((np.array(image.GetOrigin()) - SHIFT).tolist())


def words_of(line: str) -> list[str]:
    return [PLACEHOLDERS.get(word, word) for word in shlex.split(line)]


def test_the_documents_import():
    lines = documented_imports()
    assert (
        len(lines) >= 7
        and any("--seed" in line for line in lines)
        and any("--list" in line for line in lines)
    )


@pytest.mark.parametrize("line", documented_imports())
def test_a_command_line_of_the_documents(clinic, tmp_path, line):
    words = words_of(line)
    if "--organ" in words and "segmentations" in words:
        words[words.index("segmentations")] = "kidneys.nii.gz"
    if "segmentations" in words and "--side" not in words:
        words += ["--side", "left"]
    if "--out" in words:
        words[words.index("--out") + 1] = str(tmp_path / "patient")
    assert main(words) == 0
    if "--out" in words:
        findings = read_findings(tmp_path / "patient")
        is_draft = "--seed" in words
        assert (findings.side, findings.draft) == ("left", is_draft)
        assert ("tumour" in findings.surfaces) == (not is_draft)
