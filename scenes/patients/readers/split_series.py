"""Join series of one slice each, as some exports make them, to the series that they were."""

from collections import defaultdict

import numpy as np

from scenes.patients.readers.dicom_headers import Series
from scenes.patients.readers.slice_stack import SAME_GAP, SAME_PLACE_MM

# Fewer are no stack.
LEAST = 3


def joined(candidates: list[Series]) -> list[Series]:
    """The series, where several of one slice each are one: of one study, frame of reference, orientation,
    size and spacing, at even distances.
    """
    groups: dict[tuple, list[Series]] = defaultdict(list)
    for series in candidates:
        if is_single(series):
            groups[_view(series)].append(series)
    stacks = [_one_series(group) for group in groups.values() if _is_stack(group)]
    members = {uid for stack in stacks for uid in stack.uids}
    return [series for series in candidates if series.uid not in members] + stacks


def is_single(series: Series) -> bool:
    """Whether a series is one slice in one file, and nothing else."""
    return len(series.slices) == 1 and not (series.faults or series.pages or series.localizers)


def _view(series: Series) -> tuple:
    one = series.slices[0]
    axes = np.round(np.concatenate([one.row, one.column]), 3) + 0.0
    return (
        *(series.patient, series.study, series.frame_of_reference),
        *(*axes.tolist(), *np.round(one.spacing, 4).tolist(), one.rows, one.columns, bool(one.computed)),
    )


def _is_stack(group: list[Series]) -> bool:
    """Whether slices are at different positions with even distances between them."""
    gaps = np.diff(sorted(series.slices[0].along_mm for series in group))
    has_frame = bool(group[0].frame_of_reference)
    return len(group) >= LEAST and has_frame and bool(SAME_PLACE_MM < gaps.max() < SAME_GAP * gaps.min())


def _one_series(group: list[Series]) -> Series:
    group = sorted(group, key=lambda series: (len(series.number), series.number))
    first = group[0]
    return Series(
        *(first.uid, first.number, first.patient, first.study, first.frame_of_reference),
        slices=[series.slices[0] for series in group],
        other_uids=frozenset(series.uid for series in group[1:]),
        notes=[
            f"each of {len(group)} slices has a SeriesInstanceUID of its own: they were read as one series, "
            "as they share study, frame of "
            "reference, orientation, size and spacing, at even distances"
        ],
    )
