"""Carry out an import request: find CT and labels, combine them, collect the patient's identifiers (PHI)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.patients.patient_import import Patient, import_patient
from scenes.patients.patient_position import Position
from scenes.patients.readers.ct_series import ct_candidates, open_ct, read_dicom_headers
from scenes.patients.readers.dicom_headers import DicomContents, Series
from scenes.patients.readers.label_files import Segmentation, open_labels, segmentation_of
from scenes.patients.readers.label_maps import LabelMap, absent_labels, assign_tissues, merge_label_maps
from scenes.patients.readers.segment_names import Side
from scenes.patients.readers.series_choice import choose_series
from scenes.patients.readers.volume_folder import volume_files
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
    position: Position | None = None,
    progress: Progress = silent,
) -> tuple[Patient, dict[str, str]]:
    """The imported patient, and the identifiers that none of its files may contain, with where each stands.

    Args:
        ct, labels: paths of the user.
        organ: names or values of its labels.
        tissues: tissue -> names or values of its labels.
        side, support, position: as in ``import_patient``.
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
    maps: list[LabelMap] = []
    absent: tuple[str, ...] = ()
    no_tumour: tuple[str, ...] = ()
    if seed_mm is None:
        contents = None if ct.is_file() and is_volume_file(ct) else read_dicom_headers(ct, progress)
        words = [*organ, *chain(*tissues.values())]
        segmentations = _segmentations(ct, contents, labels, series, words, progress)
        volume = volume_of_labels(ct, segmentations, series, progress, contents)
        maps = [one for segmentation in segmentations for one in segmentation.maps(volume.grid)]
        empty = [segment for segmentation in segmentations for segment in segmentation.empty]
        merged = merge_label_maps(assign_tissues(maps, organ, tissues, empty))
        tumour = {tissue: words for tissue, words in tissues.items() if tissue == "tumour"}
        no_tumour = tuple(f"{text}; the labels are {merged.listed()}" for text in absent_labels(maps, tumour))
        absent = absent_labels(
            maps, {tissue: words for tissue, words in tissues.items() if tissue not in tumour}
        )
    elif labels or organ or tissues:
        raise PatientError(
            "--seed segments the organ where there are no labels: give it, or labels, not both"
        )
    else:
        volume = open_ct(ct, series, progress=progress)
        merged = draft_segmentation(volume, seed_mm)
    own = merged.values_of(organ) if organ else None
    patient = import_patient(
        volume,
        merged,
        own,
        side,
        support=support,
        given=tissues,
        position=position,
        progress=progress,
    )
    # Several files of one kind have the same note.
    sources: list[Segmentation | LabelMap] = [*segmentations, *maps]
    notes = dict.fromkeys(note for source in sources for note in source.notes)
    found = replace(
        patient,
        notes=(*patient.notes, *notes, *absent),
        warnings=(*patient.warnings, *no_tumour),
        draft=seed_mm is not None,
    )
    return found, _identifiers((ct, *labels), volume, segmentations)


def _identifiers(
    paths: Sequence[Path], volume: LazyVolume, segmentations: list[Segmentation]
) -> dict[str, str]:
    """The paths, as they are and as they were given, and what the files name; each with where it stands."""
    given = [str(path.resolve()) for path in paths] + [str(path) for path in paths if len(path.parts) > 1]
    found = dict.fromkeys(given, "the path of CT or labels")
    sources: list[LazyVolume | Segmentation] = [volume, *segmentations]
    for source in sources:
        found |= source.identifiers
    return found


def _segmentations(
    ct: Path,
    contents: DicomContents | None,
    labels: Sequence[Path],
    series: str | None,
    words: list[str],
    progress: Progress,
) -> list[Segmentation]:
    """The segmentations of the paths, else the one among the DICOM files of the CT."""
    candidates: list[Series] = []
    if contents is not None and (contents.candidates or not volume_files(ct)):
        candidates = ct_candidates(ct, contents)
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
