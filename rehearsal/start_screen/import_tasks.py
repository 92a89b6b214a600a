"""What the start screen has done in a process of its own: labels are listed, a patient is imported, and each
patient's anatomy is recognised.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from errors import UserError
from scenes.anatomy import LoadedAnatomy, fingerprint, load_anatomy
from scenes.patients.readers.segment_names import Side
from scenes.scene import EMBEDDED, Scene, load_scene, scene_file
from scenes.terminal import ReportProgress
from scenes.tumour_complexity import complexity
from ultrasound.probe import load_probe

PROBE = "drop-in"
STEPS = {
    "headers": "Reading the headers of the CT",
    "slices": "Reading the slices of the CT",
    "labels": "Reading the labels",
    "segments": "Reading the labels",
    "contours": "Filling the contours",
    "surfaces": "Making the surfaces",
}


@dataclass(frozen=True)
class FoundLabel:
    """A label of the user's files."""

    word: str
    """Its name, or its value where it has none: how a request names it."""
    value: int | None
    name: str
    tissue: str
    """By its name; empty where that is not understood."""
    volume_ml: float | None


@dataclass(frozen=True)
class ImportChoices:
    """What the user has chosen for an import; ``roles`` has "organ" or a tissue for the word of a label."""

    ct: Path
    labels: Path | None = None
    side: Side | None = None
    roles: dict[str, str] = field(default_factory=dict)

    def words(self, role: str) -> list[str]:
        """The labels of a role."""
        return [word for word, of in self.roles.items() if of == role]


@dataclass(frozen=True)
class PatientSurvey:
    """What takes a moment to find out of a patient: the fingerprint of the anatomy, and for the embedded
    patient the figures of its tumour's complexity.
    """

    anatomy: str
    complexity: dict[str, Any] | None = None


def found_labels(ct: Path, labels: Path | None, progress: ReportProgress) -> list[FoundLabel]:
    """The labels of a path; None: those in the CT's folder, of which there may be none.

    Raises PatientError.
    """
    from scenes.patients.import_listing import segments_of, segments_with_ct

    progress("Reading the labels")
    steps = _steps(progress)
    found = segments_with_ct(ct, steps) if labels is None else segments_of(labels, steps)
    return [
        FoundLabel(of.name or str(of.value), of.value, of.name, of.tissue or "", volume_ml)
        for of, volume_ml in found
    ]


def import_choices(choices: ImportChoices, out: Path, progress: ReportProgress) -> list[tuple[str, str]]:
    """Import a patient into a new folder; return the summary, a title and a line each.

    Raises PatientError.
    """
    from scenes.patients.import_folder import save_import
    from scenes.patients.import_request import import_request

    progress("Reading CT and labels")
    tissues = {role: choices.words(role) for role in {*choices.roles.values()} - {"organ"}}
    patient = import_request(
        choices.ct,
        [] if choices.labels is None else [choices.labels],
        choices.words("organ"),
        tissues,
        choices.side,
        progress=_steps(progress),
    )
    progress("Measuring the tumour, and drawing the check picture")
    return save_import(patient, out, PROBE, load_probe(PROBE).housing_mm)


def survey(scenes: Iterable[Path], progress: ReportProgress) -> dict[Path, PatientSurvey]:
    """What there is to find out of the patients of some scene files; of those that cannot be read nothing."""
    surveyed = {}
    for path in scenes:
        try:
            scene, anatomy = _anatomy(path, progress)
        except UserError:
            continue
        of_tumour = complexity(anatomy, scene.attachment.at_mm) if path == EMBEDDED else None
        surveyed[path] = PatientSurvey(
            fingerprint(anatomy), None if of_tumour is None else of_tumour.figures()
        )
    return surveyed


def _anatomy(path: Path, progress: ReportProgress) -> tuple[Scene, LoadedAnatomy]:
    file = scene_file(path)
    scene = load_scene(file)
    # The fat's thickness takes longest, and is not needed here.
    without_fat = scene.attachment.model_copy(update=dict(fat_young_kpa=0.0))
    return scene, load_anatomy(scene.model_copy(update=dict(attachment=without_fat)), file.parent, progress)


def _steps(progress: ReportProgress):
    """The steps of an import as a ``Progress``: their names, and how much of each is done."""

    def steps(things: Iterable[Any], title: str) -> Iterable[Any]:
        listed = list(things)
        for number, thing in enumerate(listed, 1):
            progress(f"{STEPS.get(title, title)}: {number} of {len(listed)}")
            yield thing

    return steps
