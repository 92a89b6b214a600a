"""Stack CT slices in any order into one rectangular, evenly spaced volume; missing and conflicting slices are
refused.

A tilted gantry shears the stack: its slices are shifted within their planes, without interpolation between
them.
"""

from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np
from scipy import ndimage

from errors import PatientError
from scenes.patients.readers.dicom_headers import DicomSlice
from scenes.patients.readers.dicom_pixels import hounsfield
from scenes.patients.readers.label_maps import listed
from scenes.volumes.lazy_volume import AIR_HU, LazyVolume
from scenes.volumes.voxel_grid import Box, VoxelGrid

# Largest deviation of a slice from the even grid, as a share of the spacing: scanners round positions to 0.1
# mm at worst.
UNEVEN = 0.1
# In-plane shift of slices, in pixels, that is not corrected.
SIDEWAYS = 0.25
# Largest deviation of a slice from the line of a tilted stack, in pixels.
OUT_OF_LINE = 1.0
# [degrees]; gantries tilt by 30 at most.
MOST_TILT = 45.0
# Spacings, relative to the median, that are resampled; outside this range a slice is missing or duplicated.
GAPS = (0.5, 1.5)
# Neighbouring gaps within this ratio are equal, as positions are rounded; so many of them are a part of a
# series.
SAME_GAP, PART_FROM_GAPS = 1.25, 3
PARALLEL = 1e-3
SAME_PLACE_MM = 1e-3
MOST_GAP_MM = 10.0
# Planes of a resampled stack are closer than the closest slices only down to this: no CT resolves less, and
# memory grows.
FINEST_MM = 0.5


def stack_slices(
    name: str,
    slices: list[DicomSlice],
    progress: Callable[[Iterable[DicomSlice]], Iterable[DicomSlice]] = iter,
) -> LazyVolume:
    """One volume of slices, in HU.

    Raises PatientError where they are too few or not parallel, or one is missing or in conflict.
    """
    if len(slices) < 2:
        raise PatientError(
            f"{name}: one slice only; expected a series of slices; give the folder of the whole series"
        )
    _check_same_geometry(name, slices)
    normal = slices[0].normal
    notes: list[str] = []
    slices = sorted(slices, key=lambda s: (float(s.position @ normal), s.number or 0))
    slices = _without_duplicates(name, slices, normal, notes)
    if len(slices) < 2:
        raise PatientError(f"{name}: all slices are at one position; expected a stack; choose another series")
    along = np.array([s.position @ normal for s in slices])
    planes, gap = _even(name, slices, along, notes)
    origin, sideways, size = _straightened(name, slices, normal, notes)
    direction = np.column_stack([slices[0].row, slices[0].column, normal])
    planes_count = int(np.floor(planes[-1] + UNEVEN)) + 1
    grid = VoxelGrid((*size, planes_count), np.array([*slices[0].spacing, gap]), origin, direction)

    def read_box(box: Box) -> np.ndarray:
        x, y, z = box
        first = max(int(np.searchsorted(planes, z.start + UNEVEN, side="right")) - 1, 0)
        last = min(int(np.searchsorted(planes, z.stop - 1 - UNEVEN, side="left")), len(slices) - 1)
        voxels = np.empty((z.stop - z.start, y.stop - y.start, x.stop - x.start), np.int16)
        before: tuple[float, np.ndarray] | None = None
        k = z.start
        for n, plane in enumerate(hounsfield(list(progress(slices[first : last + 1]))), first):
            here = float(planes[n]), _shifted(plane, sideways[n], size)[y, x]
            while k < z.stop and k <= here[0] + UNEVEN:
                voxels[k - z.start] = _between(before, here, k)
                k += 1
            before = here
        return voxels

    return LazyVolume(name, grid.checked(name), read_box, tuple(notes))


def _shifted(plane: np.ndarray, sideways: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A slice shifted along row and column [pixels] onto a grid's columns and rows; air outside it."""
    columns, rows = size
    if plane.shape == (rows, columns) and not sideways.any():
        return plane
    right, down = sideways
    wide = np.full((rows, columns), AIR_HU, np.float32)
    wide[: plane.shape[0], : plane.shape[1]] = plane
    moved = ndimage.shift(wide, (down, right), order=1, mode="constant", cval=AIR_HU)
    return np.rint(moved).astype(np.int16)


def _between(before: tuple[float, np.ndarray] | None, after: tuple[float, np.ndarray], k: int) -> np.ndarray:
    """The plane k interpolated between two slices, or a slice that is within UNEVEN of it."""
    if before is None or abs(after[0] - k) <= UNEVEN:
        return after[1]
    if abs(before[0] - k) <= UNEVEN:
        return before[1]
    share = np.float32((k - before[0]) / (after[0] - before[0]))
    return np.rint(before[1] * (1 - share) + after[1] * share).astype(np.int16)


def _check_same_geometry(name: str, slices: list[DicomSlice]) -> None:
    first = slices[0]
    for other in slices[1:]:
        turned = max(np.abs(other.row - first.row).max(), np.abs(other.column - first.column).max())
        scaled = np.abs(np.subtract(other.spacing, first.spacing)).max() > 1e-3 * first.spacing[0]
        if turned > PARALLEL or scaled or (other.rows, other.columns) != (first.rows, first.columns):
            what = "orientation" if turned > PARALLEL else "pixel spacing" if scaled else "size"
            pixels = " and ".join(
                f"{one.columns} x {one.rows} pixels of {one.spacing[0]:.3g} x {one.spacing[1]:.3g} mm"
                for one in (first, other)
            )
            raise PatientError(
                f"{name}: {first.label} and {other.label} are of different {what}: {pixels}; expected one "
                "stack of parallel "
                "slices; put the slices of one view in a separate folder, or export the series again"
            )


def _without_duplicates(
    name: str, slices: list[DicomSlice], normal: np.ndarray, notes: list[str]
) -> list[DicomSlice]:
    """Sorted slices without equal copies.

    Raises PatientError where slices at one position differ, or are several phases.
    """
    groups = [[slices[0]]]
    for one in slices[1:]:
        if (one.position - groups[-1][0].position) @ normal > SAME_PLACE_MM:
            groups.append([one])
        else:
            groups[-1].append(one)
    often = min(map(len, groups))
    for first, other in ((group[0], other) for group in groups for other in group[1:]):
        if _same(other, first):
            continue
        if len(groups) > 2 and often > 1 and len({s.sop for s in slices}) == len(slices):
            raise PatientError(
                f"{name}: all {len(groups)} positions occur {often} times: several phases in one series; "
                "expected one; put the slices "
                "of one phase, by acquisition number or time, in a separate folder"
            )
        raise PatientError(
            f"{name}: {first.label} and {other.label} are at one position, at {other.position @ normal:.2f} "
            "mm, and differ; expected "
            "each slice once; remove other phases, or the wrong copy"
        )
    copies = [copy for group in groups for copy in group[1:]]
    if copies:
        # A note is in the patient's folder: no names of files, which may be the patient's.
        numbers = ["without a number" if one.number is None else str(one.number) for one in copies]
        notes.append(f"duplicates, taken once: slice {listed(numbers)}")
    return [group[0] for group in groups]


def _same(one: DicomSlice, other: DicomSlice) -> bool:
    sideways = np.abs(one.position - other.position).max() <= SAME_PLACE_MM
    mine, its = hounsfield([one, other])
    return bool(sideways) and np.array_equal(mine, its)


def _even(
    name: str, slices: list[DicomSlice], along: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, float]:
    """Positions of the slices on an even grid [voxels], and its spacing [mm].

    Raises PatientError where one is missing or too many.
    """
    gaps = np.diff(along)
    usual = float(np.percentile(gaps, 50, method="lower"))
    least, most = GAPS

    is_even = least * usual <= gaps.min() and gaps.max() <= most * usual
    if parts := [] if is_even else _parts_of_one_spacing(gaps):
        described = ", then ".join(
            f"{gaps[part].mean():.2f} mm from {slices[part.start].label} at {along[part.start]:.2f} mm to "
            f"{slices[part.stop].label} at "
            f"{along[part.stop]:.2f} mm"
            for part in parts
        )
        raise PatientError(
            f"{name}: the series has {len(parts)} parts of different slice spacing: {described}; expected "
            "one spacing; put the slices of "
            "the part with the organ in a separate folder, or export the series with one spacing"
        )

    def pair(n: int) -> str:
        (a, b), (at_a, at_b) = slices[n : n + 2], along[n : n + 2]
        return (
            f"{a.label} at {at_a:.2f} mm and {b.label} at {at_b:.2f} mm are {gaps[n]:.2f} mm apart, the "
            f"others {usual:.2f} mm"
        )

    if gaps.max() > most * usual:
        wide = int((gaps > most * usual).sum())
        more = f" (and {wide - 1} more such gaps)" if wide > 1 else ""
        raise PatientError(
            f"{name}: {pair(int(np.argmax(gaps)))}{more}; expected no slice to be missing, and no gap over "
            f"{most:g} times the usual; "
            "copy the whole series"
        )
    if gaps.min() < least * usual:
        raise PatientError(
            f"{name}: {pair(int(np.argmin(gaps)))}; expected one stack, no gap under {least:g} times the "
            "usual; "
            "two acquisitions may overlap here: remove one"
        )
    if usual > MOST_GAP_MM + SAME_PLACE_MM:
        raise PatientError(
            f"{name}: slices are {usual:.1f} mm apart; expected at most {MOST_GAP_MM:g} mm; choose a thinner "
            "series"
        )
    extent = along[-1] - along[0]
    gap = extent / len(gaps)
    if np.abs((along - along[0]) / gap - np.arange(len(along))).max() <= UNEVEN:
        return np.arange(len(along), dtype=float), float(gap)
    planes, gap = _finest_planes(along - along[0])
    notes.append(
        f"slices are {gaps.min():.2f} to {gaps.max():.2f} mm apart: resampled to {gap:.2f} mm, linearly "
        "between neighbours"
    )
    return planes, gap


def _finest_planes(along: np.ndarray) -> tuple[np.ndarray, float]:
    """Positions [mm] of unevenly spaced slices, the first at 0, on an even grid [planes], and its spacing
    [mm].

    The spacing is at most the least gap: the largest with a plane at each slice, such as 1 mm for gaps of 5
    and 7 mm. Where there is none above FINEST_MM, it is the one with planes nearest to the slices.
    """
    closest = float(np.diff(along).min())
    worst = []
    for share in range(1, max(1, int(closest / FINEST_MM + UNEVEN)) + 1):
        gap = along[-1] / np.ceil(along[-1] * share / closest - UNEVEN)
        off = np.abs(along / gap - np.rint(along / gap)).max()
        if off <= UNEVEN:
            return along / gap, float(gap)
        worst.append((off * gap, gap))
    gap = min(worst)[1]
    return along / gap, float(gap)


def _parts_of_one_spacing(gaps: np.ndarray) -> list[slice]:
    """The parts (of ``gaps``) of a series whose spacing changes from one to another; [] where single
    slices are missing or too many.
    """
    change = 1 + np.flatnonzero(np.maximum(gaps[1:], gaps[:-1]) > SAME_GAP * np.minimum(gaps[1:], gaps[:-1]))
    runs = [slice(a, b) for a, b in pairwise([0, *change.tolist(), len(gaps)])]
    parts = [run for run in runs if run.stop - run.start >= PART_FROM_GAPS]
    means = np.array([gaps[part].mean() for part in parts])
    # Between two parts one gap may be of neither.
    between = len(gaps) - sum(part.stop - part.start for part in parts)
    if len(parts) < 2 or between > len(parts) - 1:
        return []
    changes = np.maximum(means[1:], means[:-1]) / np.minimum(means[1:], means[:-1])
    return parts if changes.min() > GAPS[1] else []


def _straightened(
    name: str, slices: list[DicomSlice], normal: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Origin of a rectangular grid that covers all slices, their in-plane shifts [pixels], and its columns
    and rows.
    """
    first = slices[0]
    axes = np.column_stack([first.row, first.column])
    positions = np.array([s.position for s in slices])
    offsets = (positions - first.position) @ axes  # (n, 2) [mm]
    spacing = np.array(first.spacing)
    size = first.columns, first.rows
    if np.abs(offsets).max() <= SIDEWAYS * spacing.min():
        return first.position, np.zeros((len(slices), 2)), size
    along = (positions - first.position) @ normal
    shear = np.median(np.diff(offsets, axis=0) / np.diff(along)[:, None], axis=0)  # of a tilted gantry
    off = offsets - along[:, None] * shear
    off = np.abs(off - np.median(off, axis=0)).max(axis=1)
    worst = int(np.argmax(off))
    if off[worst] > OUT_OF_LINE * spacing.min():
        raise PatientError(
            f"{name}: {slices[worst].label} is {off[worst]:.1f} mm to the side of its neighbours; expected "
            "slices in one "
            "line; remove the wrong slice, or export the series again"
        )
    angle = float(np.degrees(np.arctan(np.linalg.norm(shear))))
    if angle > MOST_TILT:
        raise PatientError(
            f"{name}: its slices are tilted by {angle:.1f} degrees; expected at most {MOST_TILT:g}; export "
            "the series again"
        )
    low, high = offsets.min(axis=0), offsets.max(axis=0)
    extra = np.ceil((high - low) / spacing - 1e-6).astype(int)
    notes.append(
        f"the gantry was tilted by {angle:.1f} degrees: slices shifted within their planes by up to "
        f"{np.abs(offsets).max():.1f} mm"
    )
    return (
        first.position + axes @ low,
        (offsets - low) / spacing,
        (size[0] + int(extra[0]), size[1] + int(extra[1])),
    )
