"""Open a CT: a volume file, or one series of DICOM files; or list what a path has."""

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.folder_files import entries_of
from scenes.patient_space import Space
from scenes.patients.readers.dicom_files import SourceFile, find_dicom_files
from scenes.patients.readers.dicom_headers import DicomContents, DicomSlice, Series, read_headers
from scenes.patients.readers.label_headers import label_header
from scenes.patients.readers.label_maps import listed
from scenes.patients.readers.series_choice import (
    UID_END,
    choose_series,
    gap_mm,
    in_order,
    orientation,
    patient_numbers,
    series_of_labels,
)
from scenes.patients.readers.slice_stack import stack_slices
from scenes.patients.readers.split_series import is_single, joined
from scenes.patients.readers.volume_folder import only_volume, volume_files
from scenes.surfaces import OTHER_ENDINGS, is_surface_file
from scenes.terminal import Progress, shell_command, silent
from scenes.volumes.dicom_references import NO_REFERENCES, DicomReferences
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import ENDINGS, file_volume, is_volume_file
from scenes.volumes.voxel_grid import VoxelGrid

# Up to this share of slices in another view are taken for unmarked localizers.
STRAY = 0.1


@dataclass(frozen=True)
class SeriesRow:
    """One CT of a path, for the user: without any name, ID or date."""

    number: str  # of the series; "" of a volume file
    uid_end: str  # what tells series of one number apart, else ""
    slices: int
    spacing_mm: float | None  # between slices; None where all are at one position
    pixel_mm: tuple[float, float] | None  # along rows and columns; None without a slice
    extent_mm: float  # along the body, from the foot to the head
    orientation: str  # axial, coronal, sagittal, oblique; "" without a slice
    patient: int  # 1, 2, ...
    fault: str  # why it cannot be imported; "" where it is complete


@dataclass(frozen=True)
class LabelsRow:
    """One DICOM segmentation or structure set of a path, for the user."""

    kind: str  # SEG or RTSTRUCT
    file: str  # relative to the path
    segments: tuple[str, ...]  # their names
    series: tuple[str, ...]  # numbers of the CT series in the path that it refers to
    patient: int | None  # as in the series' rows; None: of none of them
    fault: str  # why its header cannot be read, else ""


@dataclass(frozen=True)
class CtListing:
    """What a path has to import."""

    series: list[SeriesRow]  # by number
    labels: list[LabelsRow]  # by file
    unreadable: int = 0  # subfolders that cannot be listed


def list_ct(path: Path, progress: Progress = silent, space: Space | None = None) -> CtListing:
    """The CT series and DICOM labels of a path as for ``open_ct``, from their headers.

    A path with labels but without a CT has no series. Raises PatientError where the path cannot be read, or
    has neither CT nor labels.
    """
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_file() and is_volume_file(path):
        return CtListing([_row_of_file(file_volume(path, space=space))], [])
    contents, volumes = read_dicom_headers(path, progress), volume_files(path)
    files = [_row_of_file(only_volume(path, volumes, space))] if volumes and not contents.candidates else []
    candidates = in_order(contents.candidates if contents.labels or files else ct_candidates(path, contents))
    patients = patient_numbers(candidates)
    numbers = [s.number for s in candidates]
    rows = [
        _row_of_series(path, s, patient, numbers.count(s.number) > 1)
        for s, patient in zip(candidates, patients, strict=True)
    ]
    return CtListing(
        files + rows,
        [_row_of_labels(kind, item, candidates, patients) for kind, item in contents.labels],
        len(contents.unreadable),
    )


def open_ct(
    path: Path,
    series: str | None = None,
    labels: DicomReferences = NO_REFERENCES,
    grid: VoxelGrid | None = None,
    progress: Progress = silent,
    contents: DicomContents | None = None,
    space: Space | None = None,
) -> LazyVolume:
    """Find a CT and read its headers; voxels are read on demand.

    ``path`` is a folder with DICOM files, in subfolders too; a DICOMDIR; a zip archive of DICOM files; an
    enhanced CT; a .nii, .nii.gz, .nrrd, .nhdr, .mha or .mhd file, or a folder with one that is not named as
    labels. ``series`` is the number or UID (or its end) of one of several series. The series that ``labels``
    refer to is preferred; ``grid`` are the labels' own voxels, where they are a label map. ``contents`` are
    the headers of the path, where they have been read; ``space`` is that of the axes of a file that does not
    name it. ``progress`` shows the progress of headers and slices.

    Raises PatientError where the path cannot be read, or is not one complete CT.
    """
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_file() and is_volume_file(path):
        if series is not None:
            raise PatientError(f"{path}: has no series; leave --series out")
        return file_volume(path, space=space)
    contents, volumes = contents or read_dicom_headers(path, progress), volume_files(path)
    if volumes and not contents.candidates:
        if series is not None:
            raise PatientError(f"{path}: has no DICOM series; leave --series out")
        return only_volume(path, volumes, space)
    chosen, notes = choose_series(path, ct_candidates(path, contents), series, labels, grid)
    if contents.others:
        notes.append(f"left out, no CT slices: {', '.join(_counted(contents.others))}")
    if volumes:
        # No names, which may be the patient's.
        notes.append(f"left out, beside the DICOM files: {len(volumes)} NIfTI, NRRD or MHA files")
    # A damaged header may have lost the UID of its series.
    damaged = [fault for s in contents.candidates if s is not chosen and not s.slices for fault in s.faults]
    if contents.unreadable:
        notes.append(
            f"{len(contents.unreadable)} subfolders cannot be read, so the series may be incomplete; check "
            "their permissions"
        )
    with _naming("damaged", damaged), _naming("subfolders that cannot be read", contents.unreadable):
        _check_split(path, chosen, contents.candidates)
        volume = _series_volume(path, chosen, progress)
    return replace(volume, notes=(*notes, *volume.notes))


def read_dicom_headers(path: Path, progress: Progress) -> DicomContents:
    """The contents of a folder, DICOMDIR or archive with DICOM files. Raises PatientError where there are
    neither these nor other volumes.
    """
    unreadable: list[str] = []
    items = find_dicom_files(path, lambda error: unreadable.append(_below(path, error)))
    if not items and (is_surface_file(path) or path.suffix.lower() in OTHER_ENDINGS):
        raise PatientError(f"{path}: is a surface; expected a CT; give the CT first, then its labels")
    if not items and path.is_file():
        raise PatientError(
            f"{path}: unknown kind of file; expected DICOM (a folder, a DICOMDIR or a zip archive), or a "
            "file that ends in "
            f"{', '.join(ENDINGS)}; convert it"
        )
    if not items and not volume_files(path):
        if any(is_surface_file(file) for file in entries_of(path)):
            raise PatientError(
                f"{path}: has surfaces, and no CT; expected a CT before them: "
                f"{shell_command('import', 'CT', path, '--out', 'FOLDER')}"
            )
        if unreadable:
            raise PatientError(
                f"{path}: cannot be read in {listed(unreadable)}; check the permissions of these folders"
            )
        raise PatientError(
            f"{path}: no DICOM file found; give the folder of the slices, or a NIfTI, NRRD or MHA file"
        )
    contents = read_headers(items, lambda files: progress(files, "headers"))
    series = {one.uid: one for one in joined(list(contents.series.values()))}
    return replace(contents, series=series, unreadable=unreadable)


def _below(path: Path, error: OSError) -> str:
    """The folder of an error, within a path."""
    return os.path.relpath(error.filename, path)


def _check_split(path: Path, series: Series, candidates: list[Series]) -> None:
    """Raises PatientError where a series is one of several of one slice each, which do not join to one."""
    count = sum(map(is_single, candidates))
    if is_single(series) and count > 1:
        raise PatientError(
            f"{path}: {count} slices have a SeriesInstanceUID of their own each, and are no stack of one "
            "study, frame of reference, size "
            "and spacing at even distances; expected a series of slices; export it again as one series, or "
            "give it as one volume file "
            "(NIfTI, NRRD, MHA)"
        )


def ct_candidates(path: Path, contents: DicomContents) -> list[Series]:
    """All series with CT slices, also damaged ones. Raises PatientError where there are none."""
    if not contents.candidates:
        advice = "give the CT first, then the labels" if contents.labels else "give the folder of a CT series"
        raise PatientError(f"{path}: {_contents_without_ct(contents)}; expected a CT; {advice}")
    return contents.candidates


def _series_volume(path: Path, series: Series, progress: Progress) -> LazyVolume:
    """The CT of one series. Raises PatientError where it is incomplete."""
    if series.faults:
        more = len(series.faults) - 1
        fault = series.faults[0].removeprefix(f"{path.name}: ")
        raise PatientError(
            f"{path}: {fault}{f' (and {more} more files of this series)' if more else ''}; "
            "export the series again"
        )
    if len(series.pages) > len(series.slices):
        raise PatientError(
            f"{path}: {len(series.pages)} of {len(series.pages) + len(series.slices)} files of this series "
            "are no slices: "
            f"{next(iter(series.pages.values())).removeprefix(f'{path.name}: ')}; export the series again"
        )
    slices, strays = _one_view(series)
    notes = list(series.notes)
    if series.pages:
        notes.append(f"left out, no slices, such as screen saves: {len(series.pages)}")
    if series.projections:
        notes.append(
            f"left out, computed from the slices, such as MIP and MPR: {len(series.projections)} images"
        )
    if series.localizers + len(strays):
        notes.append(f"left out, localisers: {series.localizers + len(strays)}")
    if not all(one.is_rescaled for one in slices):
        notes.append("the files have no rescale: their values were taken as HU")
    positions = {one.patient_position for one in slices} - {""}
    if len(positions) > 1:
        notes.append("the slices have different PatientPositions: none was taken")
    strange = [one.label for one in strays]
    with (
        _naming("in another view or size", strange),
        _naming("no slices", list(series.pages)),
        _naming("computed from the slices", series.projections),
    ):
        stack = stack_slices(str(path), slices, lambda files: progress(files, "slices"))
    return replace(
        stack,
        notes=(*notes, *stack.notes),
        references=series.references,
        series=series.number if series.number.isdecimal() else "",
        patient_position=positions.pop() if len(positions) == 1 else "",
    )


@contextmanager
def _naming(what: str, left_out: Sequence[str]) -> Iterator[None]:
    """Add to an error the files that were left out of a series, which may lack them."""
    try:
        yield
    except PatientError as error:
        if not left_out:
            raise
        raise PatientError(f"{error}; left out, {what}: {listed(left_out)}") from error


def _row_of_file(volume: LazyVolume) -> SeriesRow:
    grid = volume.grid
    x, y, spacing = grid.spacing.tolist()
    return SeriesRow(
        number="",
        uid_end="",
        slices=grid.size[2],
        spacing_mm=spacing,
        pixel_mm=(x, y),
        extent_mm=float(np.ptp(grid.corners()[:, 2])),
        orientation=orientation(grid.direction[:, 2]),
        patient=1,
        fault="",
    )


def _row_of_series(path: Path, series: Series, patient: int, with_uid: bool) -> SeriesRow:
    fault = ""
    try:
        _series_volume(path, series, silent)
    except PatientError as error:
        fault = str(error).removeprefix(f"{path}: ")
    first = series.slices[0] if series.slices else None
    return SeriesRow(
        number=series.number,
        uid_end=series.uid[-UID_END:] if with_uid else "",
        slices=len(series.slices),
        spacing_mm=gap_mm(series),
        pixel_mm=first.spacing if first else None,
        extent_mm=float(np.ptp([one.heights_mm for one in series.slices])) if first else 0.0,
        orientation=orientation(first.normal) if first else "",
        patient=patient,
        fault=fault,
    )


def _row_of_labels(kind: str, item: SourceFile, candidates: list[Series], patients: list[int]) -> LabelsRow:
    try:
        header = label_header(kind, item)
    except PatientError as error:
        return LabelsRow(kind, item.name, (), (), None, str(error))
    theirs = series_of_labels(candidates, header.references)
    related = theirs or [s for s in candidates if s.patient and s.patient == header.references.patient]
    of = {patient for s, patient in zip(candidates, patients, strict=True) if s in related}
    return LabelsRow(
        kind, item.name, header.names, tuple(s.number for s in theirs), of.pop() if len(of) == 1 else None, ""
    )


def _counted(kinds: Counter[str]) -> list[str]:
    return [f"{count} {what}" for what, count in sorted(kinds.items())]


def _contents_without_ct(contents: DicomContents) -> str:
    localizers = Counter(localisers=sum(series.localizers for series in contents.series.values()))
    kinds = _counted(contents.others) + _counted(Counter(kind for kind, _ in contents.labels) + localizers)
    return f"no CT slices, but {', '.join(kinds)}" if kinds else "no CT slices"


def _one_view(series: Series) -> tuple[list[DicomSlice], list[DicomSlice]]:
    """The slices without a few in another view, and those."""

    def view(one: DicomSlice) -> tuple:
        return (*np.round(np.concatenate([one.row, one.column]), 2).tolist(), one.rows, one.columns)

    views = [view(one) for one in series.slices]
    main = max(views, key=views.count)
    kept, strays = (
        [one for one, seen in zip(series.slices, views, strict=True) if (seen == main) == is_kept]
        for is_kept in (True, False)
    )
    return (kept, strays) if len(strays) <= STRAY * len(views) else (series.slices, [])
