"""The patients that the start screen shows: the embedded one, and the folders in ``patients/``.

No name of a folder is shown, as it may be the patient's.
"""

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from time import time
from typing import Any

import numpy as np
from PIL import Image

from errors import UserError
from rehearsal.result_files import counted, next_number
from scenes.import_findings import ImportFindings, read_findings
from scenes.scene import EMBEDDED, load_scene, scene_file

# Where patients are looked for and imported to, in the folder where the program runs.
PATIENTS_FOLDER = Path("patients")
NEW_NAME = r"patient-([0-9]{3,9})"
CHECK_PICTURE, SCENE_FILE = "check.png", "scene.toml"
NO_PATIENT = (
    "This is no patient's folder, or it is damaged: import the patient again, or see what is wrong with: "
    "python app.py rehearse FOLDER"
)
# That of the embedded patient, and the middle of the first section in a check picture, where the outlines
# are: left, top, right and bottom as shares of its size.
EMBEDDED_PICTURE = Path(__file__).parents[2] / "docs" / CHECK_PICTURE
FIRST_SECTION = (0.07, 0.143, 0.291, 0.442)
AGES = ((86_400.0, "day"), (3600.0, "hour"), (60.0, "minute"))


@dataclass(frozen=True)
class ListedPatient:
    """A patient to choose: the scene's path, and what is shown of it."""

    scene: Path
    title: str
    lines: tuple[str, ...]
    warnings: int = 0
    """Of the import, which nobody has acknowledged."""
    fault: str = ""
    """Why it cannot be rehearsed."""

    @property
    def picture(self) -> np.ndarray | None:
        """A section of its CT, uint8, shape (height, width, 3); None without one."""
        path = EMBEDDED_PICTURE if self.scene == EMBEDDED else self.scene / CHECK_PICTURE
        return first_section(path, path.stat().st_mtime_ns) if path.is_file() else None


def listed_patients(folder: Path, figures: dict[str, Any] | None = None) -> list[ListedPatient]:
    """The embedded patient, with the figures of its complexity once they are known, and the patients in the
    subfolders of a folder, the last imported first.
    """
    # A hidden folder is one that an import is writing, or has left when it was stopped.
    shown = [path for path in folder.glob("*") if not path.name.startswith(".")]
    found = [path for path in shown if os.path.isfile(path / SCENE_FILE)]
    found.sort(key=lambda path: (path / SCENE_FILE).stat().st_mtime, reverse=True)
    about = "Left kidney with a tumour, drawn from formulas: no patient's data"
    embedded = ListedPatient(EMBEDDED, "Embedded patient", (about, *complexity_lines(figures)))
    return [embedded, *map(listed_patient, found)]


def listed_patient(folder: Path) -> ListedPatient:
    """The patient in a folder."""
    try:
        scene, findings = load_scene(scene_file(folder)), read_findings(folder)
    except UserError:
        return ListedPatient(folder, "No patient", (), fault=NO_PATIENT)
    title = scene.title or "Kidney"
    imported = f"Imported {age_text(folder / SCENE_FILE)}"
    if findings is None:
        return ListedPatient(folder, title, (imported,))
    lines = *tumour_lines(findings), *complexity_lines(findings.complexity), imported
    return ListedPatient(folder, title, lines, len(findings.open_warnings))


def tumour_lines(findings: ImportFindings) -> list[str]:
    """The size of the tumour."""
    figures = findings.complexity
    if figures is None:
        return ["No tumour labelled"]
    several = f", largest of {figures['tumours']}" if figures["tumours"] > 1 else ""
    return [f"Tumour of {figures['diameter_mm']:.0f} mm{several}"]


def complexity_lines(figures: dict[str, Any] | None) -> list[str]:
    """The scores of a tumour's complexity, as in import.json."""
    scores = () if figures is None else (("R.E.N.A.L.", figures["renal"]), ("PADUA", figures["padua"]))
    return [f"{name} {_total(score)}{score['suffix']}, {score['complexity']}" for name, score in scores]


def _total(score: dict[str, Any]) -> str:
    return f"{score['least']}" if score["least"] == score["most"] else f"{score['least']}-{score['most']}"


def age_text(path: Path) -> str:
    """How long ago a file or folder was written: no date, which would belong to the patient."""
    return since_text(time() - path.stat().st_mtime)


def since_text(seconds: float) -> str:
    """A time in the past in words: "3 days ago"."""
    for length_s, unit in AGES:
        if seconds >= length_s:
            return f"{counted(int(seconds // length_s), unit)} ago"
    return "just now"


def new_folder_name(folder: Path) -> Path:
    """A folder for the next patient, of a name that names nobody."""
    return folder / f"patient-{next_number(folder, NEW_NAME):03d}"


@lru_cache(maxsize=64)
def first_section(path: Path, written_ns: int) -> np.ndarray | None:
    """The first section of a check picture that was written at a time, uint8, shape (height, width, 3); None
    where it cannot be read.
    """
    try:
        with Image.open(path) as image:
            width, height = image.size
            left, top, right, bottom = FIRST_SECTION
            box = left * width, top * height, right * width, bottom * height
            return np.asarray(image.convert("RGB").crop(box))
    except (OSError, Image.DecompressionBombError):
        return None
