"""The listing of ``import --list``: CT series and labels of the user's paths, before anything is made."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from errors import PatientError
from scenes.patient_space import Space
from scenes.patients.readers.ct_series import CtListing, LabelsRow, SeriesRow, list_ct
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_maps import Segment
from scenes.terminal import Progress, silent
from scenes.volumes.voxel_grid import VoxelGrid

SERIES_HEADS = ("series", "slices", "spacing, mm", "pixels, mm", "extent, mm", "view", "patient")
SEGMENT_HEADS = ("value", "name", "tissue", "side", "ml")
MOST_NAMES = 12
# Label maps do not ask for the CT's grid.
AS_THEY_ARE = VoxelGrid((1, 1, 1), np.ones(3), np.zeros(3), np.eye(3))


def listing_text(
    ct: Path, labels: Sequence[Path] = (), progress: Progress = silent, space: Space | None = None
) -> str:
    """CT series and labels as tables: without any name, ID or date of the patient, but with the names of
    files and labels.

    Raises PatientError where a path cannot be read.
    """
    listed = list_ct(ct, progress, space)
    faults = [f"series {_name(row)} cannot be imported: {row.fault}" for row in listed.series if row.fault]
    if listed.unreadable:
        faults.append(
            f"{listed.unreadable} subfolders cannot be read: series may be incomplete; check their "
            "permissions"
        )
    parts = [_series_table(listed), "\n".join(faults), _labels_table(listed.labels)]
    parts += [_labels_text(path, progress, space) for path in labels]
    return "\n\n".join(filter(None, parts))


def _series_table(listed: CtListing) -> str:
    if not listed.series:
        return "no CT series"
    several = len({row.patient for row in listed.series}) > 1
    return _table([_series_row(row, several) for row in listed.series], SERIES_HEADS, disable_numparse=True)


def _table(rows: Sequence[tuple], heads: Sequence[str], **options: Any) -> str:
    """Rows as text, without the columns that are empty in all of them."""
    shown = [n for n in range(len(heads)) if any(row[n] not in (None, "") for row in rows)]
    return tabulate([[row[n] for n in shown] for row in rows], [heads[n] for n in shown], **options)


def _series_row(row: SeriesRow, several: bool) -> tuple[str, ...]:
    spacing = "" if row.spacing_mm is None else f"{row.spacing_mm:.2f}"
    pixels = "" if row.pixel_mm is None else "{:.2f} x {:.2f}".format(*row.pixel_mm)
    extent, patient = f"{row.extent_mm:.0f}", str(row.patient) if several else ""
    return _name(row), str(row.slices), spacing, pixels, extent, row.orientation, patient


def _name(row: SeriesRow) -> str:
    return f"{row.number or 'file'}{f', UID ends in {row.uid_end}' if row.uid_end else ''}"


def _labels_table(rows: list[LabelsRow]) -> str:
    """DICOM labels, a line each."""
    lines = []
    for row in rows:
        more = f" and {len(row.segments) - MOST_NAMES} more" if len(row.segments) > MOST_NAMES else ""
        names = ", ".join(row.segments[:MOST_NAMES]) or "no segment"
        of = f"; of series {', '.join(row.series)}" if row.series else ""
        lines.append(f"{row.kind} {row.file}: {row.fault or names + more}{of}")
    return "\n".join(lines)


def _labels_text(path: Path, progress: Progress, space: Space | None) -> str:
    """The labels of one path: their segments with volumes; of DICOM, which needs its CT for that, the
    names.
    """
    if of_dicom := _dicom_labels(path, progress):
        return _labels_table(of_dicom)
    rows = [
        (of.value, of.name, of.tissue, of.side, volume_ml)
        for of, volume_ml in _segments(path, progress, space)
    ]
    return f"{path.name}:\n" + _table(rows, SEGMENT_HEADS, floatfmt=".1f")


def segments_of(
    path: Path, progress: Progress = silent, space: Space | None = None
) -> list[tuple[Segment, float | None]]:
    """The segments of a path's labels, each with its volume [ml]; of DICOM, which needs its CT for that,
    without one.

    Raises PatientError where the path cannot be read, or has no labels.
    """
    if of_dicom := _dicom_labels(path, progress):
        return _named(of_dicom)
    return list(_segments(path, progress, space))


def segments_with_ct(ct: Path, progress: Progress = silent) -> list[tuple[Segment, float | None]]:
    """The segments of the DICOM labels in a CT's path, without volumes; none where there are no labels.

    Raises PatientError where the path cannot be read.
    """
    return _named(list_ct(ct, progress).labels)


def _named(rows: list[LabelsRow]) -> list[tuple[Segment, float | None]]:
    return [(Segment.named(name), None) for row in rows for name in row.segments]


def _dicom_labels(path: Path, progress: Progress) -> list[LabelsRow]:
    try:
        return list_ct(path, progress).labels
    except PatientError:
        return []


def _segments(path: Path, progress: Progress, space: Space | None) -> Iterator[tuple[Segment, float]]:
    for one in open_labels(path, progress=progress, space=space).maps(AS_THEY_ARE):
        counts = np.zeros(1 + max(one.segments), int)
        for plane in one.values:  # of a whole volume, bincount takes eight bytes a voxel
            counts += np.bincount(plane.ravel(), minlength=len(counts))
        yield from ((segment, counts[value] * one.grid.voxel_ml) for value, segment in one.segments.items())
