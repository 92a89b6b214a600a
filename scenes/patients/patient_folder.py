"""Write a patient's folder: voxels, surfaces and texts of the program's own words, so that nothing in it
identifies the patient (PHI).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import SimpleITK as sitk

from scenes.atomic_files import new_folder
from scenes.patients.part_surfaces import PARTS
from scenes.patients.patient_import import Patient
from scenes.patients.readers.segment_names import public_text
from scenes.surfaces import save_surface
from scenes.volumes.volume_files import save_image


def save_patient(
    patient: Patient,
    folder: Path,
    texts: dict[str, str] | None = None,
    draw: Callable[[Path], None] | None = None,
) -> None:
    """Write ct.nrrd, labels.nrrd, corrections.nrrd if there are any, organ.stl, support.stl and a surface for
    each part into a folder: all or nothing.

    Of the patient only voxels and geometry are written. ``texts`` are further text files (the scene) by name;
    ``draw`` writes further files into a folder (the check image). Raises PatientError where the folder exists
    and is not empty, or cannot be written.
    """
    with new_folder(folder) as partial:
        _write(patient, partial, texts or {})
        if draw is not None:
            draw(partial)


def _write(patient: Patient, folder: Path, texts: dict[str, str]) -> None:
    images = {"ct": patient.ct, "labels": patient.labels}
    if patient.corrections is not None:
        images["corrections"] = patient.corrections
    for name, image in images.items():
        bare = sitk.GetImageFromArray(sitk.GetArrayViewFromImage(image))  # without metadata
        bare.CopyInformation(image)
        save_image(bare, folder / f"{name}.nrrd")
    save_surface(patient.organ, folder / "organ.stl")
    save_surface(patient.support, folder / "support.stl")
    for tissue, surface in patient.parts.items():
        save_surface(surface, folder / f"{PARTS[tissue]}.stl")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def public(patient: Patient) -> Patient:
    """The patient as its folder describes it: notes and warnings without names of labels that may be a
    person's.
    """
    return replace(
        patient,
        notes=tuple(map(public_text, patient.notes)),
        warnings=tuple(map(public_text, patient.warnings)),
    )
