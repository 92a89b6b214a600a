"""Carry out an import request: find CT and labels, combine them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.patient_space import Space
from scenes.patients.organ_selection import organ_values
from scenes.patients.patient_import import Patient, import_patient
from scenes.patients.patient_position import Position
from scenes.patients.readers.ct_series import ct_candidates, open_ct, read_dicom_headers
from scenes.patients.readers.dicom_headers import DicomContents, Series
from scenes.patients.readers.label_files import Segmentation, open_labels, segmentation_of
from scenes.patients.readers.label_maps import LabelMap
from scenes.patients.readers.label_merge import merge_label_maps
from scenes.patients.readers.segment_choice import absent_labels, assign_tissues, choose_segments, with_commas
from scenes.patients.readers.segment_names import Side
from scenes.patients.readers.series_choice import choose_series
from scenes.patients.readers.volume_folder import volume_files
from scenes.patients.region_growing import draft_segmentation
from scenes.terminal import Progress, silent
from scenes.volumes.dicom_references import NO_REFERENCES, DicomReferences, doubts, mismatch
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import is_volume_file


@dataclass(frozen=True)
class OrganLabels:
    """The labels of a request, merged."""

    merged: LabelMap
    own: list[int] | None = None  # values of the organ that the user named
    drawn: tuple[LabelMap, ...] = ()  # before they were merged, which covers some of them
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


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
    space: Space | None = None,
) -> Patient:
    """The patient that a user imports from the paths ``ct`` and ``labels``, or from a seed instead of labels.

    ``organ`` has names or values of the organ's labels, ``tissues`` those of each tissue's. ``side``,
    ``support`` and ``position`` are as in ``import_patient``. ``series`` is the number or UID of one of
    several series; ``seed_mm`` (3,) is in LPS; ``space`` is that of the axes of files that do not name it.
    ``progress`` shows the progress of each step.

    Raises PatientError, which names what was found, what was expected and what to do.
    """
    if not ct.exists():
        raise PatientError(f"{ct}: no such file or folder; check the path")
    tissues = tissues or {}
    if seed_mm is None:
        contents = None if ct.is_file() and is_volume_file(ct) else read_dicom_headers(ct, progress)
        words = [*organ, *chain(*tissues.values())]
        segmentations = _segmentations(ct, contents, labels, series, words, progress, space)
        assumed = any(segmentation.space for segmentation in segmentations)
        of_classes = [segmentation for segmentation in segmentations if segmentation.is_class_image]
        segmentations = [segmentation for segmentation in segmentations if not segmentation.is_class_image]
        if not segmentations:
            raise PatientError(
                "the labels are a class image alone, which corrects tissues and has no organ; give the "
                "kidney's labels beside it"
            )
        volume = volume_of_labels(ct, segmentations, series, progress, contents, space)
        of_organ = organ_labels(segmentations, volume, organ, tissues)
        classes = [one for segmentation in of_classes for one in segmentation.maps(volume.grid)]
        assumed = assumed or volume.space is not None
    elif labels or organ or tissues:
        raise PatientError(
            "--seed segments the organ where there are no labels: give it, or labels, not both"
        )
    else:
        volume = open_ct(ct, series, progress=progress, space=space)
        assumed = volume.space is not None
        of_organ, classes = OrganLabels(draft_segmentation(volume, seed_mm)), []
    if space is not None and not assumed:
        raise PatientError(
            f"--space {space}: every file states where its axes point; leave --space out, or correct the "
            "file that states it wrongly"
        )
    patient = import_patient(
        volume,
        of_organ.merged,
        of_organ.own,
        side,
        support=support,
        assigned=tissues,
        drawn=of_organ.drawn,
        position=position,
        progress=progress,
        classes=classes,
    )
    return replace(
        patient,
        notes=(*patient.notes, *of_organ.notes),
        warnings=(*patient.warnings, *of_organ.warnings),
        draft=seed_mm is not None,
        space=space,
    )


def organ_labels(
    segmentations: Sequence[Segmentation],
    volume: LazyVolume,
    organ: Sequence[str],
    tissues: Mapping[str, Sequence[str]],
) -> OrganLabels:
    """The labels of all sources on a CT, with the tissues that the user assigned by names or values.

    Raises PatientError.
    """
    maps = [one for segmentation in segmentations for one in segmentation.maps(volume.grid)]
    empty = [segment for segmentation in segmentations for segment in segmentation.empty]
    organ = with_commas(organ, maps, empty)
    tissues = {tissue: with_commas(words, maps, empty) for tissue, words in tissues.items()}
    assigned = assign_tissues(maps, organ, tissues, empty)
    drawn, notes_of_choice = choose_segments(assigned, [*organ, *chain(*tissues.values())], bool(organ))
    merged, own = merge_label_maps(drawn, organ)
    sources: list[Segmentation | LabelMap] = [*segmentations, *maps]
    # Several files of one kind have the same note.
    notes = tuple(dict.fromkeys(note for source in sources for note in source.notes)) + notes_of_choice
    try:
        organ_values(merged, own)
    except PatientError as error:
        raise PatientError("; ".join([str(error), *notes])) from error
    absent = {tissue: absent_labels(maps, {tissue: words}) for tissue, words in tissues.items()}
    no_tumour = [f"{text}; the labels are {merged.listed()}" for text in absent.pop("tumour", ())]
    return OrganLabels(
        merged=merged,
        own=own,
        drawn=tuple(drawn),
        notes=(*notes, *chain(*absent.values())),
        warnings=(*no_tumour, *chain(*(one.warnings for one in maps))),
    )


def _segmentations(
    ct: Path,
    contents: DicomContents | None,
    labels: Sequence[Path],
    series: str | None,
    words: list[str],
    progress: Progress,
    space: Space | None,
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
        return [open_labels(path, words, progress, belongs, space) for path in labels]
    segmentation = segmentation_of(contents, words, progress, belongs) if contents else None
    if segmentation is None:
        raise PatientError(
            f"{ct}: no labels are with this CT; give a file or folder with LABELS, or --seed X,Y,Z for a "
            "draft"
        )
    return [segmentation]


def volume_of_labels(
    ct: Path,
    segmentations: list[Segmentation],
    series: str | None = None,
    progress: Progress = silent,
    contents: DicomContents | None = None,
    space: Space | None = None,
) -> LazyVolume:
    """The CT that the labels were drawn on. Raises PatientError where they belong to another."""
    labels = next((s.references for s in segmentations if s.references != NO_REFERENCES), NO_REFERENCES)
    grid = next((s.grid for s in segmentations if s.grid), None)
    volume = open_ct(ct, series, labels, grid, progress, contents, space)
    for segmentation in segmentations:
        fault = mismatch(segmentation.references, volume.references)
        if fault:
            raise PatientError(
                f"{ct}: the labels {fault} this CT series; expected the CT that they were drawn on; choose "
                "it with --series, or give "
                "its folder"
            )
    notes = [note for s in segmentations for note in doubts(s.references, volume.references)]
    return replace(volume, notes=(*volume.notes, *dict.fromkeys(notes)))
