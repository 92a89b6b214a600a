"""The folder of an imported patient: scene, findings and check picture beside voxels and surfaces."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from scenes.import_findings import FINDINGS_FILE, findings_text
from scenes.patients.check_picture import draw_check, summary_rows
from scenes.patients.patient_complexity import complexity_of_patient
from scenes.patients.patient_findings import findings_of
from scenes.patients.patient_folder import public, save_patient
from scenes.patients.patient_import import Patient
from scenes.patients.patient_scene import fat_row, patient_scene, stiffness_row
from scenes.scene import scene_text
from scenes.section import Vector3


def save_import(
    patient: Patient,
    out: Path,
    probe: str,
    housing_mm: Vector3,
    uniform: bool = False,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> list[tuple[str, str]]:
    """Write the folder of an imported patient; return its summary, a title and a line each.

    ``probe`` is that of the scene, in a housing of a size [mm]; ``uniform``: one stiffness for all tissue.
    ``texts`` are further text files by name. Raises PatientError where the folder cannot be written.
    """
    complexity = complexity_of_patient(patient)
    written = public(patient)
    scene = patient_scene(patient, uniform, probe, housing_mm)
    of_scene = [stiffness_row(scene), fat_row(patient, scene)]
    rows = [*summary_rows(written, complexity), *of_scene]
    files = dict(texts) | {
        "scene.toml": scene_text(scene),
        FINDINGS_FILE: findings_text(findings_of(written, complexity)),
    }
    save_patient(written, out, files, lambda folder: draw_check(written, rows, folder))
    return [*summary_rows(patient, complexity), *of_scene]
