"""Carry out an import request: find CT and labels, combine them, collect the patient's identifiers (PHI)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.patients.patient_import import Patient, import_patient
from scenes.patients.readers.ct_series import open_ct, read_dicom_headers
from scenes.patients.readers.label_files import Segmentation, open_labels, segmentation_of
from scenes.patients.readers.label_maps import absent_labels, assign_tissues, merge_label_maps
from scenes.patients.readers.segment_names import Side
from scenes.patients.region_growing import draft_segmentation
from scenes.terminal import Progress, silent
from scenes.volumes.lazy_volume import LazyVolume


def import_request(
    ct: Path,
    labels: Sequence[Path] = (),
    organ: Sequence[str] = (),
    tissues: Mapping[str, Sequence[str]] | None = None,
    side: Side | None = None,
    series: str | None = None,
    seed_mm: np.ndarray | None = None,
    support: str = "mould",
    progress: Progress = silent,
) -> tuple[Patient, set[str]]:
    """The imported patient, and the identifiers that none of its files may contain.

    Args:
        ct, labels: paths of the user.
        organ: names or values of its labels.
        tissues: tissue -> names or values of its labels.
        side, support: as in ``import_patient``.
        series: number or UID of one of several series.
        seed_mm: (3,) LPS; instead of labels.
        progress: shows the progress of each step.

    Raises:
        PatientError: what was found, what was expected and what to do.
    """
    if not ct.exists():
        raise PatientError(f"{ct}: no such file or folder; check the path")
    tissues = tissues or {}
    segmentations: list[Segmentation] = []
    absent: tuple[str, ...] = ()
    if seed_mm is None:
        segmentations = _segmentations(ct, labels, [*organ, *chain(*tissues.values())], progress)
        volume = volume_of_labels(ct, segmentations, series, progress)
        maps = [one for segmentation in segmentations for one in segmentation.maps(volume.grid)]
        empty = [segment for segmentation in segmentations for segment in segmentation.empty]
        merged = merge_label_maps(assign_tissues(maps, organ, tissues, empty))
        absent = absent_labels(maps, tissues)
    elif labels or organ or tissues:
        raise PatientError(
            "--seed segments the organ where there are no labels: give it, or labels, not both"
        )
    else:
        volume = open_ct(ct, series, progress=progress)
        merged = draft_segmentation(volume, seed_mm)
    own = merged.values_of(organ) if organ else None
    patient = import_patient(volume, merged, own, side, support=support, given=tissues, progress=progress)
    # Several files of one kind have the same note.
    notes = dict.fromkeys(note for segmentation in segmentations for note in segmentation.notes)
    paths = {str(path.resolve()) for path in (ct, *labels)}
    paths |= {str(path) for path in (ct, *labels) if len(path.parts) > 1}
    identifiers = paths.union(
        volume.identifiers, *(segmentation.identifiers for segmentation in segmentations)
    )
    return replace(patient, notes=(*patient.notes, *notes, *absent), draft=seed_mm is not None), identifiers


def _segmentations(
    ct: Path, labels: Sequence[Path], words: list[str], progress: Progress
) -> list[Segmentation]:
    """The segmentations of the paths, else the one in the CT's folder."""
    if labels:
        return [open_labels(path, words, progress) for path in labels]
    found = segmentation_of(read_dicom_headers(ct, progress)) if ct.is_dir() else None
    if found is None:
        raise PatientError(
            f"{ct}: no labels are with this CT; give a file or folder with LABELS, or --seed X,Y,Z for a draft"
        )
    return [found]


def volume_of_labels(
    ct: Path, segmentations: list[Segmentation], series: str | None = None, progress: Progress = silent
) -> LazyVolume:
    """The CT that the labels were drawn on. Raises PatientError where they have another frame of reference."""
    referenced = next((found.referenced for found in segmentations if found.referenced), "")
    volume = open_ct(ct, series, referenced, progress)
    for segmentation in segmentations:
        if len({segmentation.frame_of_reference, volume.frame_of_reference} - {""}) > 1:
            raise PatientError(
                f"{ct}: the labels have another frame of reference than this series; expected the CT that they "
                "were drawn on; choose it with --series, or give its folder"
            )
    return volume
