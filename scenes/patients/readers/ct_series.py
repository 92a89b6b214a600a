"""Open a CT: a volume file, or one series of DICOM files."""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from errors import PatientError
from scenes.patients.readers.dicom_files import find_dicom_files
from scenes.patients.readers.dicom_headers import DicomContents, DicomSlice, Series, read_headers
from scenes.patients.readers.identifiers import identifiers_of
from scenes.patients.readers.label_maps import listed
from scenes.patients.readers.segment_names import is_understood
from scenes.patients.readers.slice_stack import stack_slices
from scenes.terminal import Progress, silent
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.volume_files import ENDINGS, file_volume, is_volume_file

# Up to this share of slices in another view are taken for unmarked localizers.
STRAY = 0.1
# Characters of a UID that identify a series; series numbers are shorter.
UID_END = 6
# In the names of label maps, such as KiTS's segmentation.nii.gz; others are named as a structure.
LABEL_NAME = re.compile(
    r"(?i)(?<![a-z])(seg|segmentations?|labels?|labelmap|masks?|annotations?|rois?)(?![a-z])"
)
# In the names of CTs that would be structures.
CT_NAME = re.compile(r"(?i)(?<![a-z])(ct|image|arterial|(portal)?venous)(?![a-z])|phase")


def open_ct(
    path: Path, series: str | None = None, referenced: str = "", progress: Progress = silent
) -> LazyVolume:
    """Find a CT and read its headers; voxels are read on demand.

    Args:
        path: a folder with DICOM files, in subfolders too; a DICOMDIR; a zip archive of DICOM files; an enhanced CT;
            a .nii, .nii.gz, .nrrd, .nhdr, .mha or .mhd file, or a folder with one that is not named as labels.
        series: number or UID (or its end) of one of several series.
        referenced: UID of the series that the labels refer to, which is preferred.

    Raises:
        PatientError: not readable, or not one complete CT.
    """
    if not path.exists():
        raise PatientError(f"{path}: no such file or folder; check the path")
    if path.is_file() and is_volume_file(path):
        if series is not None:
            raise PatientError(f"{path}: has no series; leave --series out")
        return file_volume(path)
    found, volumes = read_dicom_headers(path, progress), _volume_files(path)
    if volumes and not any(s.slices or s.faults for s in found.series.values()):
        if series is not None:
            raise PatientError(f"{path}: has no DICOM series; leave --series out")
        return _only_volume(path, volumes)
    stack = _series_volume(path, found, series, referenced, progress)
    # No names, which may be the patient's.
    note = f"left out, beside the DICOM files: {len(volumes)} NIfTI, NRRD or MHA files"
    return replace(stack, notes=(*stack.notes, note)) if volumes else stack


def _volume_files(path: Path) -> list[Path]:
    """The volume files of a folder and its subfolders; none of a file."""
    entries = path.rglob("*") if path.is_dir() else ()
    return sorted(file for file in entries if is_volume_file(file) and file.is_file())


def _only_volume(folder: Path, files: list[Path]) -> LazyVolume:
    """The one volume file of a folder that is not named as labels. Raises PatientError where there are several, or labels alone."""
    images = [file for file in files if not _is_named_as_labels(file)] if len(files) > 1 else files
    if len(images) != 1:
        names = listed([str(file.relative_to(folder)) for file in images or files])
        raise PatientError(
            f"{folder}: has {len(images) or len(files)} files that may be the CT{'' if images else ', all named as labels'}: {names}; "
            "expected one; give its path as CT"
        )
    volume = file_volume(images[0])
    chosen = f"of {len(files)} volume files, the one that is not named as labels was taken as the CT"
    return replace(
        volume,
        notes=(*volume.notes, *(chosen,) * (len(files) > 1)),
        identifiers=volume.identifiers | {str(images[0]), str(images[0].resolve())},
    )


def _is_named_as_labels(file: Path) -> bool:
    name = file.name.partition(".")[0]
    if file.name.lower().endswith(".seg.nrrd") or LABEL_NAME.search(name):
        return True
    return is_understood(name) and not CT_NAME.search(name)


def read_dicom_headers(path: Path, progress: Progress) -> DicomContents:
    """The contents of a folder, DICOMDIR or archive with DICOM files. Raises PatientError where there are neither these nor other
    volumes.
    """
    items = find_dicom_files(path)
    if not items and path.is_file():
        raise PatientError(
            f"{path}: unknown kind of file; expected DICOM (a folder, a DICOMDIR or a zip archive), or a file that ends in "
            f"{', '.join(ENDINGS)}; convert it"
        )
    if not items and not _volume_files(path):
        raise PatientError(
            f"{path}: no DICOM file found; give the folder of the slices, or a NIfTI, NRRD or MHA file"
        )
    return read_headers(items, lambda files: progress(files, "headers"))


def _series_volume(
    path: Path, found: DicomContents, wanted: str | None, referenced: str, progress: Progress
) -> LazyVolume:
    """The CT of one series: the ``wanted`` one by number or UID, else the ``referenced`` one, else the best.

    Raises PatientError: no CT, no such series, or an incomplete one.
    """
    candidates = [s for s in found.series.values() if s.slices or s.faults]
    if not candidates:
        raise PatientError(
            f"{path}: {_contents_without_ct(found)}; expected a CT; give the folder of a CT series"
        )
    series, notes = choose_series(path, candidates, wanted, referenced)
    if series.faults:
        more = len(series.faults) - 1
        fault = series.faults[0].removeprefix(f"{path.name}: ")
        raise PatientError(
            f"{path}: {fault}{f' (and {more} more files of this series)' if more else ''}; "
            "export the series again"
        )
    slices, left_out = _one_view(series)
    if series.localizers + left_out:
        notes.append(f"left out, localisers: {series.localizers + left_out}")
    if found.others:
        notes.append(f"left out, no CT slices: {', '.join(_counted(found.others))}")
    if not all(one.is_rescaled for one in slices):
        notes.append("the files have no rescale: their values were taken as HU")
    stack = stack_slices(str(path), slices, lambda files: progress(files, "slices"))
    return replace(
        stack,
        notes=(*notes, *stack.notes),
        frame_of_reference=series.frame_of_reference,
        identifiers=identifiers_of(slices[0].item),
    )


def _counted(kinds: Counter[str]) -> list[str]:
    return [f"{count} {what}" for what, count in sorted(kinds.items())]


def _contents_without_ct(found: DicomContents) -> str:
    localizers = Counter(localisers=sum(series.localizers for series in found.series.values()))
    kinds = _counted(found.others) + _counted(Counter(kind for kind, _ in found.labels) + localizers)
    return f"no CT slices, but {', '.join(kinds)}" if kinds else "no CT slices"


def choose_series(
    path: Path, candidates: list[Series], wanted: str | None, referenced: str
) -> tuple[Series, list[str]]:
    """The chosen series, and a note with the reason where there are several. Raises PatientError."""
    ranked = sorted(candidates, key=lambda s: _rank(s, referenced), reverse=True)
    numbers = [s.number for s in candidates]
    listed = "; ".join(
        _described(s, numbers.count(s.number) > 1)
        for s in sorted(candidates, key=lambda s: (len(s.number), s.number))
    )
    if wanted is not None:
        matching = [
            s for s in candidates if s.number == wanted or (len(wanted) >= UID_END and s.uid.endswith(wanted))
        ]
        if len(matching) != 1:
            what = "no series" if not matching else f"{len(matching)} series"
            raise PatientError(
                f"{path}: --series {wanted} is {what}; expected the number of one of these, or the end of its UID: {listed}"
            )
        return matching[0], []
    best = ranked[0]
    if len(candidates) == 1:
        return best, []
    why = "it covers most of the body with the thinnest slices"
    if best.uid == referenced:
        why = "the labels refer to it"
    elif _rank(best, "")[:-1] == _rank(ranked[1], "")[:-1]:
        why = "of several equal ones the lowest number"
    return best, [
        f"of {len(candidates)} series, number {best.number} was taken: {why}; there are: {listed}; --series N takes another"
    ]


def _rank(series: Series, referenced: str) -> tuple:
    """Sort key, larger is better: referenced by labels, usable, axial, extent in steps of 5 cm, number of slices."""
    along = [one.along_mm for one in series.slices] or [0.0]
    axial = bool(series.slices) and abs(series.slices[0].normal[2]) > 0.9
    number = float(series.number) if series.number.isdecimal() else 1e9
    return (
        series.uid == referenced,
        not series.faults and len(series.slices) > 1,
        axial,
        round((max(along) - min(along)) / 50),
        len(series.slices),
        -number,
    )


def _described(series: Series, with_uid: bool) -> str:
    """Number, slices and spacing, and if needed the end of the UID; no free text, which may name the patient."""
    places = np.unique([round(one.along_mm, 2) for one in series.slices])
    gap = f", {np.median(np.diff(places)):.2f} mm apart" if len(places) > 1 else ""
    uid = f", UID ends in {series.uid[-UID_END:]}" if with_uid else ""
    return f"series {series.number} (CT, {len(series.slices)} slices{gap}{uid})"


def _one_view(series: Series) -> tuple[list[DicomSlice], int]:
    """The slices without a few in another view, and how many those are."""

    def view(one: DicomSlice) -> tuple:
        return (*np.round(np.concatenate([one.row, one.column]), 2).tolist(), one.rows, one.columns)

    views = [view(one) for one in series.slices]
    main = max(views, key=views.count)
    kept = [one for one, seen in zip(series.slices, views, strict=True) if seen == main]
    stray = len(views) - len(kept)
    if stray and stray <= STRAY * len(views):
        return kept, stray
    return series.slices, 0
