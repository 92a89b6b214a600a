"""Carry out an import request: find CT and labels, combine them, collect the patient's identifiers (PHI)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.patients.patient_import import Patient, import_patient
from scenes.patients.readers.ct_series import open_ct, read_dicom_headers
from scenes.patients.readers.label_files import Segmentation, open_labels, segmentation_of
from scenes.patients.readers.label_maps import LabelMap, assign_tissues, merge_label_maps
from scenes.patients.readers.segment_names import Side
from scenes.patients.region_growing import draft_segmentation
from scenes.terminal import Progress, silent
from scenes.volumes.lazy_volume import LazyVolume


@dataclass(frozen=True)
class ImportRequest:
    """The user's request: paths, and labels by names or values."""

    ct: Path
    labels: Sequence[Path] = ()
    organ: Sequence[str] = ()
    tissues: Mapping[str, Sequence[str]] = field(default_factory=dict)  # tissue -> labels
    side: Side | None = None
    series: str | None = None
    seed_mm: np.ndarray | None = None  # (3,) LPS; instead of labels
    support: str = "mould"


def import_request(request: ImportRequest, progress: Progress = silent) -> tuple[Patient, set[str]]:
    """The imported patient, and the identifiers that none of its files may contain. Raises PatientError."""
    if not request.ct.exists():
        raise PatientError(f"{request.ct}: no such file or folder; check the path")
    if request.seed_mm is not None:
        if request.labels or request.organ or request.tissues:
            raise PatientError(
                "--seed segments the organ where there are no labels: give it, or labels, not both"
            )
        segmentations: list[Segmentation] = []
        volume = open_ct(request.ct, request.series, progress=progress)
        labels = draft_segmentation(volume, request.seed_mm)
        notes: tuple[str, ...] = ()
    else:
        volume, segmentations, labels = with_labels(request, progress)
        notes = tuple(note for segmentation in segmentations for note in segmentation.notes)
    organ = labels.values_of(request.organ) if request.organ else None
    patient = import_patient(
        volume,
        labels,
        organ,
        request.side,
        support=request.support,
        needed=set(request.tissues),
        progress=progress,
    )
    identifiers = set(volume.identifiers).union(*(segmentation.identifiers for segmentation in segmentations))
    is_draft = request.seed_mm is not None
    return replace(patient, notes=(*patient.notes, *notes), draft=is_draft), identifiers | _paths(request)


def with_labels(
    request: ImportRequest, progress: Progress
) -> tuple[LazyVolume, list[Segmentation], LabelMap]:
    """The CT, its segmentations, and one label map of all with the tissues that the user assigned. Raises PatientError."""
    words = [*request.organ, *(word for several in request.tissues.values() for word in several)]
    segmentations = [open_labels(path, words, progress) for path in request.labels]
    segmentations = segmentations or [_beside(request.ct, progress)]
    referenced = next(
        (segmentation.referenced for segmentation in segmentations if segmentation.referenced), ""
    )
    volume = open_ct(request.ct, request.series, referenced, progress)
    for segmentation in segmentations:
        frames = {segmentation.frame_of_reference, volume.frame_of_reference} - {""}
        if len(frames) > 1:
            raise PatientError(
                f"{request.ct}: the labels have another frame of reference than this series; expected the CT that they "
                "were drawn on; choose it with --series, or give its folder"
            )
    maps = [one for segmentation in segmentations for one in segmentation.maps(volume.grid)]
    return volume, segmentations, merge_label_maps(assign_tissues(maps, request.organ, request.tissues))


def _beside(ct: Path, progress: Progress) -> Segmentation:
    """The segmentation in a CT's folder."""
    found = segmentation_of(read_dicom_headers(ct, progress)) if ct.is_dir() else None
    if found is None:
        raise PatientError(
            f"{ct}: no labels are with this CT; give a file or folder with LABELS, or --seed X,Y,Z for a draft"
        )
    return found


def _paths(request: ImportRequest) -> set[str]:
    """The paths of the source, absolute and as given."""
    given = [request.ct, *request.labels]
    return {str(path.resolve()) for path in given} | {str(path) for path in given if len(path.parts) > 1}
