"""Choose one of several CT series: by the user's word, by the labels, else the best; never silently one of
several patients.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.patients.readers.dicom_headers import Series
from scenes.volumes.dicom_references import NO_REFERENCES, DicomReferences
from scenes.volumes.voxel_grid import VoxelGrid

# Characters of a UID that identify a series; series numbers are shorter.
UID_END = 6
# Share of the labels' grid that a series must contain to be theirs.
CONTAINED = 0.99
# How labels show that a series is theirs, the surest last.
REASONS = (
    "", "the labels lie in it", "the labels have its voxels", "the labels have its patient ID",
    "the labels have its frame of reference", "the labels refer to its slices", "the labels refer to it",
)  # fmt: skip
BY_FRAME = 4


def choose_series(
    path: Path,
    candidates: list[Series],
    wanted: str | None = None,
    labels: DicomReferences = NO_REFERENCES,
    grid: VoxelGrid | None = None,
) -> tuple[Series, list[str]]:
    """The chosen one of all CT series, and a note with the reason where there are several.

    ``wanted`` is the number of a series, or its UID or the end of it. ``labels`` are what the labels refer
    to; ``grid`` are the labels' own voxels, where they are a label map. Errors name the ``path``. Raises
    PatientError where there is no such series, or series of several patients, of which the labels show none
    to be theirs.
    """
    if wanted is not None:
        return _wanted(path, candidates, wanted), []
    sure = {s: _certainty(s, labels, grid) for s in candidates}
    ranked = sorted(candidates, key=lambda s: (sure[s], *_rank(s)), reverse=True)
    best = ranked[0]
    if len(candidates) == 1:
        return best, []
    patients = dict(zip(candidates, patient_numbers(candidates), strict=True))
    count, surest = len(set(patients.values())), sure[best]
    theirs = [s for s in ranked if sure[s] == surest]
    if len({patients[s] for s in theirs}) > 1:
        named = any(s.patient for s in candidates)
        what = f"CTs of {count} patients" if named else f"CTs of {count} studies, and no patient ID"
        unsure = ", and the labels do not show which" if grid or labels != NO_REFERENCES else ""
        raise PatientError(
            f"{path}: {what}: {listed_series(candidates)}; expected one patient{unsure}; choose a series "
            "with --series, or give the "
            "folder of one patient"
        )
    why = [REASONS[surest]] * (len(theirs) < len(ranked))
    if len(theirs) > 1:
        equal = _rank(best)[:-1] == _rank(theirs[1])[:-1]
        why.append(
            "of several equal ones the lowest number"
            if equal
            else "it covers most of the body with the thinnest slices"
        )
    of_patients = f" of {count} patients" if count > 1 else ""
    return best, [
        f"of {len(candidates)} series{of_patients}, number {best.number} was taken: "
        f"{', and '.join(why)}; there are: {listed_series(candidates)}; "
        "--series N takes another"
    ]


def _wanted(path: Path, candidates: list[Series], wanted: str) -> Series:
    matching = [
        s for s in candidates if s.number == wanted or (len(wanted) >= UID_END and s.uid.endswith(wanted))
    ]
    if len(matching) != 1:
        what = "no series" if not matching else f"{len(matching)} series"
        raise PatientError(
            f"{path}: --series {wanted} is {what}; expected the number of one of these, or the end of its "
            f"UID: {listed_series(candidates)}"
        )
    return matching[0]


def in_order(candidates: Sequence[Series]) -> list[Series]:
    """Series by their numbers."""
    return sorted(candidates, key=lambda s: (len(s.number), s.number))


def patient_numbers(candidates: Sequence[Series]) -> list[int]:
    """The number of each series' patient, from 1 in the order of the series; the same PatientID is the same
    patient.

    Without an ID it is the patient of the study, without that of the frame of reference.
    """
    of_study = {s.study: s.patient for s in candidates if s.study and s.patient}
    identities = [s.patient or of_study.get(s.study) or s.study or s.frame_of_reference for s in candidates]
    order = {s: n for n, s in enumerate(in_order(candidates))}
    ranked = sorted(zip(candidates, identities, strict=True), key=lambda pair: order[pair[0]])
    numbers = {identity: n for n, identity in enumerate(dict.fromkeys(i for _, i in ranked), start=1)}
    return [numbers[identity] for identity in identities]


def series_of_labels(candidates: Sequence[Series], labels: DicomReferences) -> list[Series]:
    """The series that labels refer to, else those of their frame of reference."""
    sure = [_certainty(s, labels, None) for s in candidates]
    return [s for s, one in zip(candidates, sure, strict=True) if one == max(sure) >= BY_FRAME]


def _certainty(series: Series, labels: DicomReferences, grid: VoxelGrid | None) -> int:
    """How surely labels belong to a series: an index of REASONS."""
    own = series.references
    levels = (
        labels.patient and labels.patient == own.patient,
        labels.frames & own.frames,
        labels.instances & own.instances,
        labels.series & own.series,
    )
    certainty = max((n for n, shared in enumerate(levels, start=3) if shared), default=0)
    if certainty or grid is None or len(series.slices) < 2:
        return certainty
    return _on_its_voxels(series, grid)


def _on_its_voxels(series: Series, grid: VoxelGrid) -> int:
    """2 where a label map has the voxels of a series, 1 where it lies in it, else 0."""
    first = series.slices[0]
    axes = np.column_stack([first.row, first.column, first.normal])
    along = np.unique([round(one.along_mm, 2) for one in series.slices])
    low = np.array([*(first.position @ axes)[:2], along[0]])
    size = np.array([first.columns, first.rows, len(along)])
    gap = max(float(np.ptp(along)) / max(1, len(along) - 1), 1e-3)
    spacing = np.array([*first.spacing, gap])
    corners = (grid.corners() @ axes - low) / spacing
    start, end = corners.min(axis=0), corners.max(axis=0)
    if np.prod(grid.size) == np.prod(size) and max(np.abs(start).max(), np.abs(end - size + 1).max()) < 0.5:
        return 2
    within = np.clip(end, -0.5, size - 0.5) - np.clip(start, -0.5, size - 0.5)
    return int(np.prod(within / np.maximum(end - start, 1e-3)) >= CONTAINED)


def _rank(series: Series) -> tuple:
    """Sort key, larger is better: usable, axial, extent in steps of 5 cm, number of slices."""
    along = [one.along_mm for one in series.slices] or [0.0]
    number = float(series.number) if series.number.isdecimal() else 1e9
    return (
        not series.faults and len(series.slices) > 1,
        bool(series.slices) and orientation(series.slices[0].normal) == "axial",
        round((max(along) - min(along)) / 50),
        len(series.slices),
        -number,
    )


def orientation(normal: np.ndarray) -> str:
    """Axial, coronal, sagittal or oblique, by the normal (3,) of the slices, LPS."""
    axis = int(np.abs(normal).argmax())
    return ("sagittal", "coronal", "axial")[axis] if abs(normal[axis]) > 0.9 else "oblique"


def gap_mm(series: Series) -> float | None:
    """The median distance between neighbouring slices [mm]; None where all are at one position."""
    places = np.unique([round(one.along_mm, 2) for one in series.slices])
    return float(np.median(np.diff(places))) if len(places) > 1 else None


def listed_series(candidates: Sequence[Series]) -> str:
    """Number, slices and spacing of each, and if needed the end of the UID and the patient; no free text,
    which may name the patient.
    """
    numbers = [s.number for s in candidates]
    patients = patient_numbers(candidates)
    shown = dict(zip(candidates, patients, strict=True)) if max(patients) > 1 else {}

    def described(series: Series) -> str:
        gap = gap_mm(series)
        apart = "" if gap is None else f", {gap:.2f} mm apart"
        uid = f", UID ends in {series.uid[-UID_END:]}" if numbers.count(series.number) > 1 else ""
        patient = f", patient {shown[series]}" if shown else ""
        return f"series {series.number} (CT, {len(series.slices)} slices{apart}{uid}{patient})"

    return "; ".join(map(described, in_order(candidates)))
