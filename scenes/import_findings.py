"""The findings of an import: ``import.json`` in a patient's folder.

Its warnings are shown until the user acknowledges them.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from errors import explained
from scenes.atomic_files import atomic_write
from scenes.patient_space import Space
from scenes.scene import Scene, SceneError
from scenes.section import Vector3
from scenes.terminal import shell_command
from settings import Section
from text_files import TextError, read_text

FINDINGS_FILE = "import.json"
DRAFT_REMARK = "Draft segmentation: made by region growing from a seed, drawn by nobody"


class ImportWarning(Section):
    """What looks wrong in the CT and its labels, or was assumed, and whether the user has acknowledged it."""

    text: str
    acknowledged: bool = False


class GridFindings(Section):
    """A voxel grid in LPS [mm]; ``direction`` has the three axes of the voxels as columns, row by row."""

    size: tuple[int, int, int]
    spacing_mm: Vector3
    origin_mm: Vector3
    direction: tuple[Vector3, Vector3, Vector3]


class SurfaceFindings(Section):
    """A closed surface, and the volume that its label has."""

    faces: int
    volume_ml: float
    label_ml: float | None = None


class ImportFindings(Section):
    """What an import found. No name, ID, date, UID or path of the patient."""

    version: str
    side: Literal["left", "right"]
    draft: bool
    position: Literal["supine", "prone", "left-decubitus", "right-decubitus"]
    """How the patient lay in the CT."""
    space: Space | None = None
    """Where the axes of files point that do not name it, by the user; None where every file names it."""
    extent_mm: Vector3
    """Of the organ: right-left, front-back, foot-head."""
    length_mm: float | None = None
    """From pole to pole, without tumours and cysts; None in files that were written without it."""
    surfaces: dict[str, SurfaceFindings]
    """Of the organ, its parts by tissue, and the support."""
    series: str
    """Number of the CT's series; empty without one."""
    source: GridFindings
    """The CT as it was given, before it was cropped around the organ."""
    ct: GridFindings
    """The CT and the labels in the folder."""
    tissues: dict[str, str]
    """Tissue of each value of the labels in the folder."""
    complexity: dict[str, Any] | None
    """Of the tumour, as in report.json; None without a tumour."""
    warnings: tuple[ImportWarning, ...]
    notes: tuple[str, ...]
    """What was chosen, left out or resampled."""

    @property
    def open_warnings(self) -> tuple[str, ...]:
        """The warnings that nobody has acknowledged."""
        return tuple(warning.text for warning in self.warnings if not warning.acknowledged)

    @property
    def acknowledged_warnings(self) -> tuple[str, ...]:
        """The warnings that the user has acknowledged."""
        return tuple(warning.text for warning in self.warnings if warning.acknowledged)


def findings_text(findings: ImportFindings) -> str:
    """The content of ``import.json``."""
    return findings.model_dump_json(indent=2) + "\n"


def read_findings(folder: Path) -> ImportFindings | None:
    """The findings in a patient's folder; None where there are none, as before version 2.

    Raises SceneError.
    """
    path = folder / FINDINGS_FILE
    try:
        return ImportFindings.model_validate_json(read_text(path))
    except FileNotFoundError:
        return None
    except (NotADirectoryError, TextError) as error:
        raise SceneError(f"{path}: cannot be read ({error}); check that it can be read") from None
    except ValidationError as error:
        raise SceneError(
            f"{path}: {explained(error)}; expected the findings of app.py import; import the patient again, "
            "or remove this file and its "
            "warnings"
        ) from None


def open_warnings(scene: Scene, folder: Path) -> tuple[str, ...]:
    """The warnings of a scene's import that nobody has acknowledged. Raises SceneError."""
    findings = _findings_of(scene, folder)
    return () if findings is None else findings.open_warnings


def acknowledged_warnings(scene: Scene, folder: Path) -> tuple[str, ...]:
    """The warnings of a scene's import that the user has acknowledged: they are still true of its images.

    Raises SceneError.
    """
    findings = _findings_of(scene, folder)
    return () if findings is None else findings.acknowledged_warnings


def side_of(scene: Scene, folder: Path) -> Literal["left", "right"] | None:
    """The side of a scene's kidney; None where no import has stated it. Raises SceneError."""
    if scene.anatomy.phantom:
        return "left"
    findings = read_findings(folder)
    return None if findings is None else findings.side


def import_remarks(scene: Scene, folder: Path) -> list[str]:
    """What others who look at a scene must know of its import: that it is a draft, and all warnings.

    Raises SceneError.
    """
    findings = _findings_of(scene, folder)
    if findings is None:
        return []
    return [
        *([DRAFT_REMARK] if findings.draft else []),
        *(f"Warning of the import, not acknowledged: {text}" for text in findings.open_warnings),
        *(f"Warning of the import, acknowledged: {text}" for text in findings.acknowledged_warnings),
    ]


def _findings_of(scene: Scene, folder: Path) -> ImportFindings | None:
    return None if scene.anatomy.phantom else read_findings(folder)


def acknowledge(folder: Path, shown: Collection[str]) -> None:
    """Mark the warnings of a patient's folder that were shown as acknowledged: since then the patient may
    have been imported again.

    Raises SceneError, OSError.
    """
    findings = read_findings(folder)
    if findings is not None:
        checked = tuple(
            warning.model_copy(update=dict(acknowledged=warning.acknowledged or warning.text in shown))
            for warning in findings.warnings
        )
        with atomic_write(folder / FINDINGS_FILE) as partial:
            partial.write_text(findings_text(findings.model_copy(update=dict(warnings=checked))), "utf-8")


def warning_lines(warnings: tuple[str, ...], folder: Path) -> list[str]:
    """Warnings for the terminal, and how to acknowledge them."""
    if not warnings:
        return []
    how = f"Check {folder / 'check.png'}, then: {shell_command('acknowledge', folder)}"
    return [*(f"WARNING of the import: {text}" for text in warnings), how]
