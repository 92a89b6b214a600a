"""Carry out an import request: find CT and labels, combine them, collect the patient's identifiers (PHI)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.patients.patient_import import Patient, import_patient
from scenes.patients.readers.ct_series import ct_candidates, open_ct, read_dicom_headers
from scenes.patients.readers.dicom_headers import DicomContents
from scenes.patients.readers.label_files import Segmentation, open_labels, segmentation_of
from scenes.patients.readers.label_maps import assign_tissues, merge_label_maps
from scenes.patients.readers.segment_names import Side
from scenes.patients.readers.series_choice import choose_series
from scenes.patients.region_growing import draft_segmentation
from scenes.terminal import Progress, silent
from scenes.volumes.dicom_references import NO_REFERENCES, DicomReferences, doubts, mismatch
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import is_volume_file


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
    if seed_mm is None:
        found = None if is_volume_file(ct) else read_dicom_headers(ct, progress)
        words = [*organ, *chain(*tissues.values())]
        segmentations = _segmentations(ct, found, labels, series, words, progress)
        volume = volume_of_labels(ct, segmentations, series, progress, found)
        maps = [one for segmentation in segmentations for one in segmentation.maps(volume.grid)]
        merged = merge_label_maps(assign_tissues(maps, organ, tissues))
    elif labels or organ or tissues:
        raise PatientError(
            "--seed segments the organ where there are no labels: give it, or labels, not both"
        )
    else:
        volume = open_ct(ct, series, progress=progress)
        merged = draft_segmentation(volume, seed_mm)
    own = merged.values_of(organ) if organ else None
    patient = import_patient(
        volume, merged, own, side, support=support, needed=set(tissues), progress=progress
    )
    notes = [note for segmentation in segmentations for note in segmentation.notes]
    paths = {str(path.resolve()) for path in (ct, *labels)}
    paths |= {str(path) for path in (ct, *labels) if len(path.parts) > 1}
    identifiers = paths.union(
        volume.identifiers, *(segmentation.identifiers for segmentation in segmentations)
    )
    return replace(patient, notes=(*patient.notes, *notes), draft=seed_mm is not None), identifiers


def _segmentations(
    ct: Path,
    contents: DicomContents | None,
    labels: Sequence[Path],
    series: str | None,
    words: list[str],
    progress: Progress,
) -> list[Segmentation]:
    """The segmentations of the paths, else the one among the DICOM files of the CT."""
    candidates = ct_candidates(ct, contents) if contents else []
    if series is not None and candidates:
        candidates = [choose_series(ct, candidates, series)[0]]
    own = [one.references for one in candidates]

    def belongs(references: DicomReferences) -> bool:
        return not own or any(not mismatch(references, one) for one in own)

    if labels:
        return [open_labels(path, words, progress, belongs) for path in labels]
    found = segmentation_of(contents, words, progress, belongs) if contents else None
    if found is None:
        raise PatientError(
            f"{ct}: no labels are with this CT; give a file or folder with LABELS, or --seed X,Y,Z for a draft"
        )
    return [found]


def volume_of_labels(
    ct: Path,
    segmentations: list[Segmentation],
    series: str | None = None,
    progress: Progress = silent,
    contents: DicomContents | None = None,
) -> LazyVolume:
    """The CT that the labels were drawn on. Raises PatientError where they belong to another."""
    labels = next((s.references for s in segmentations if s.references != NO_REFERENCES), NO_REFERENCES)
    grid = next((s.grid for s in segmentations if s.grid), None)
    volume = open_ct(ct, series, labels, grid, progress, contents)
    for segmentation in segmentations:
        fault = mismatch(segmentation.references, volume.references)
        if fault:
            raise PatientError(
                f"{ct}: the labels {fault} this CT series; expected the CT that they were drawn on; choose it with --series, or give "
                "its folder"
            )
    found = [note for s in segmentations for note in doubts(s.references, volume.references)]
    return replace(volume, notes=(*volume.notes, *dict.fromkeys(found)))
