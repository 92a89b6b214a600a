"""Stack the closed contours of a region on evenly spaced planes, interpolated where a plane has no contour.

Interpolation is shape-based (Raya and Udupa 1990): signed distances of the planes below and above, weighted
by their nearness.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from errors import PatientError
from scenes.patients.readers.contour_fill import COPY_PIXELS, fill_plane
from scenes.patients.readers.label_maps import Segment, box_of, listed
from scenes.patients.readers.segment_names import quoted
from scenes.patients.readers.slice_stack import UNEVEN
from scenes.terminal import Progress
from scenes.volumes.voxel_grid import Box, VoxelGrid

# Contours within this height [mm] are of one plane.
SAME_PLANE_MM = 0.1
# A contour this near to a plane, as a share of the distance of planes, is on it: a CT's slices may be UNEVEN,
# and decimals are rounded.
ON_PLANE = UNEVEN + 0.01
# The widest gap that is interpolated [mm]: three slices of 5 mm.
MOST_GAP_MM = 15.0
# A gap is near to one beside it in width up to this: contours on every second slice, then on every fourth;
# one slice left out.
WIDER = 2.5
# A gap so much wider than usual lacks a contour, and so far beyond its last section a body may reach.
LACKS = 1.5
# Neighbouring planes of one body share so much of the smaller one's area.
LEAST_OVERLAP = 0.25


# The walls of an organ and its lesions are thicker; two contours of one organ, by two observers, may be as
# far apart.
WALL_MM = 2.5


@dataclass(frozen=True)
class DrawnRegion:
    """A region's contours."""

    file: str
    segment: Segment
    contours: list[np.ndarray]  # corners (n, 3) of each closed contour, LPS [mm]
    is_organ: bool  # whether no part of it must be lost, and it is solid: it is no thin shell
    is_exclusive: bool  # whether its contours are exclusive where they cross, too (CLOSEDPLANAR_XOR)

    def __str__(self) -> str:
        return f"{self.file}: region {self.segment}"


@dataclass(frozen=True)
class FilledRegion:
    """A region's mask."""

    grid: VoxelGrid
    inside: np.ndarray  # bool (z, y, x)
    notes: tuple[str, ...]  # what was mended
    warnings: tuple[str, ...]  # what was missing


@dataclass(frozen=True)
class _Planes:
    """The planes of a region's contours."""

    heights: np.ndarray  # (n,), rising [slices of the CT]
    inside: np.ndarray  # bool (n, y, x)
    corner: np.ndarray  # (2,) column and row of the first pixel
    ct: VoxelGrid

    @property
    def gaps_mm(self) -> np.ndarray:
        """Distances of neighbours, (n - 1,)."""
        return np.diff(self.heights) * self.ct.spacing[2]

    @property
    def areas(self) -> np.ndarray:
        """Area of each [mm^2], (n,)."""
        return self.inside.sum(axis=(1, 2)) * float(np.prod(self.ct.spacing[:2]))

    def place(self, height: float) -> str:
        """A height in words: the coordinate of the region's middle along the patient's axis that is
        nearest to the slices' normal.
        """
        rows, columns = self.inside.shape[1:]
        middle = self.corner + np.array([columns - 1, rows - 1]) / 2
        axis = int(np.argmax(np.abs(self.ct.direction[:, 2])))
        return f"{'xyz'[axis]} {self.ct.place([*middle, height])[axis]:.1f}"


def stack_contours(
    region: DrawnRegion, ct: VoxelGrid, near: Box | None, progress: Progress
) -> FilledRegion | None:
    """A region on planes of its contours, or on the CT's where these are uneven; in each a CT's pixels. None
    where none is near.

    Nested contours on one plane alternate between inside and outside; contours that cross are united; a
    contour that stands there twice counts once. An organ that has no pixel gets those nearest to its
    contours, with a warning. Nothing is filled outside the box of voxels ``near``; None: all is filled.
    ``progress`` shows the progress of the planes.

    Raises PatientError where contours are far outside the CT or not parallel to its slices, or an organ has a
    gap that is too wide to interpolate.
    """
    places = [ct.index(corners) for corners in region.contours]
    _check_places(str(region), places, ct)
    ends = np.array(ct.size)
    least, most = (-ends, 2 * ends) if near is None else np.array([(a.start, a.stop - 1) for a in near]).T
    places = [p for p in places if (p.max(axis=0) >= least).all() and (p.min(axis=0) <= most).all()]
    if not places:
        return None
    low = np.floor(np.min([p[:, :2].min(axis=0) for p in places], axis=0)).astype(int) - 1
    high = np.ceil(np.max([p[:, :2].max(axis=0) for p in places], axis=0)).astype(int) + 1
    low, high = np.maximum(low, least[:2]), np.minimum(high, most[:2])
    columns, rows = (high - low + 1).tolist()

    slice_mm = float(ct.spacing[2])
    heights, groups = _by_plane(np.array([place[:, 2].mean() for place in places]), slice_mm)
    levels, step = _even_planes(heights, slice_mm)
    origin = ct.place(np.array([low[0], low[1], levels[0]]))
    size = columns, rows, max(2, len(levels))
    grid = VoxelGrid(size, ct.spacing * (1, 1, step), origin, ct.direction).checked(str(region))

    wall = np.maximum(WALL_MM / ct.spacing[1::-1], COPY_PIXELS) if region.is_organ else None
    drawn = [[places[n][:, 1::-1] - low[::-1] for n in group] for group in groups]
    inside, counts = np.zeros((len(groups), rows, columns), bool), np.zeros(3, int)
    for plane, corners in progress(list(zip(inside, drawn, strict=True)), "contours"):
        one = fill_plane(corners, plane.shape, wall, region.is_exclusive)
        plane[:] = one.inside
        counts += one.copies, one.differing, one.united
    notes, warnings = _notes(*counts.tolist()), tuple[str, ...]()
    if region.is_organ and not inside.any():
        _mark_nearest(inside, drawn)
        name = quoted(region.segment.name)
        warnings = (
            f"{name} is smaller than a pixel: no contour encloses a pixel's centre; the pixel nearest to the "
            "middle of each was marked",
        )
    if len(levels) != len(heights) or np.abs(levels - heights).max() > ON_PLANE * step:
        planes = _Planes(heights, inside, low, ct)
        inside, uneven, lacking = _on_levels(region, planes, levels, step)
        notes, warnings = (*notes, *uneven), (*warnings, *lacking)
    if len(inside) < size[2]:
        inside = np.concatenate([inside, np.zeros_like(inside)])
    return FilledRegion(grid, inside, notes, warnings)


def _notes(copies: int, differing: int, united: int) -> tuple[str, ...]:
    """What was mended in the planes."""
    by_others = f"; {differing} of them differ, and the larger one counts" if differing else ""
    twice = f"contours that stand twice in a plane, counted once: {copies}{by_others}"
    crossing = f"contours that overlap in a plane, united: {united}"
    return (twice,) * bool(copies) + (crossing,) * bool(united)


def _mark_nearest(inside: np.ndarray, drawn: list[list[np.ndarray]]) -> None:
    """Mark, in planes (n, y, x), the pixel nearest to the middle of each contour, whose corners are rows
    and columns [pixels].
    """
    last = np.array(inside.shape[1:]) - 1
    for plane, contours in zip(inside, drawn, strict=True):
        for corners in contours:
            plane[tuple(np.clip(np.rint(corners.mean(axis=0)), 0, last).astype(int))] = True


def _check_places(name: str, places: list[np.ndarray], ct: VoxelGrid) -> None:
    """Raises PatientError where corners (voxels of the CT) are far outside it, or those of a contour are
    of several slices.
    """
    ends = np.array(ct.size)
    if any((place < -ends).any() or (place > 2 * ends).any() for place in places):
        raise PatientError(
            f"{name}: contours are far outside this CT; expected contours on it; give the CT that they were "
            "drawn on"
        )
    if max(np.ptp(place[:, 2]) for place in places) > 1:
        raise PatientError(
            f"{name}: contours cross the slices of this CT; expected contours on them; give the CT that they "
            "were drawn on"
        )


def _by_plane(heights: np.ndarray, slice_mm: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """The planes of contours at some heights [slices], as a CT's slices where all are there, and the
    contours (indices) of each.
    """
    if np.abs(heights - np.rint(heights)).max() <= ON_PLANE:
        heights = np.rint(heights)
    order = np.argsort(heights, kind="stable")
    first, starts = -np.inf, []
    for n, height in enumerate(heights[order]):
        if (height - first) * slice_mm > SAME_PLANE_MM:
            first = height
            starts.append(n)
    groups = np.split(order, starts[1:])
    return np.array([heights[group].mean() for group in groups]), groups


def _even_planes(heights: np.ndarray, slice_mm: float) -> tuple[np.ndarray, float]:
    """Heights [slices] of even planes with those of the contours among them, and their distance; else the
    CT's own planes.
    """
    if len(heights) == 1:
        return heights, 1.0
    gaps = np.diff(heights)
    numbers = np.concatenate([[0.0], np.cumsum(np.rint(gaps / gaps.min()))])
    step, first = np.polyfit(numbers, heights, 1)
    off = np.abs(first + step * numbers - heights).max()
    if off <= ON_PLANE * min(step, 1.0) and step * slice_mm <= MOST_GAP_MM:
        return first + step * np.arange(numbers[-1] + 1), float(step)
    reach = max(1.0, _usual(gaps)) / 2
    return np.arange(np.floor(heights[0] - reach) + 1, np.ceil(heights[-1] + reach)), 1.0


def _usual(gaps: np.ndarray) -> float:
    """The usual one of some gaps."""
    return float(np.percentile(gaps, 50, method="lower"))


def _on_levels(
    region: DrawnRegion, drawn: _Planes, levels: np.ndarray, step: float
) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """The mask on even planes (``levels``, ``step`` [slices]): as drawn, interpolated, or as the nearest
    plane at an end; notes and warnings.
    """
    continues, warnings = _continues(region, drawn)
    gaps = np.diff(drawn.heights)
    usual = _usual(gaps)
    inside = np.zeros((len(levels), *drawn.inside.shape[1:]), bool)
    used = np.zeros(len(drawn.heights), bool)
    lacking, uneven = [], 0
    for plane, level in zip(inside, levels, strict=True):
        nearest = int(np.argmin(np.abs(drawn.heights - level)))
        off = abs(drawn.heights[nearest] - level)
        below = int(np.searchsorted(drawn.heights, level)) - 1
        if off > ON_PLANE * step and 0 <= below < len(gaps) and continues[below]:
            pair = slice(below, below + 2)
            share = (level - drawn.heights[below]) / gaps[below]
            plane[:] = _interpolated(drawn.inside[pair], share, drawn.ct.spacing)
            used[pair] = True
            if gaps[below] > LACKS * usual:
                lacking.append(drawn.place(level))
            else:
                uneven += 1
        elif off <= ON_PLANE * step or off < max(step, usual) / 2:
            plane[:] = drawn.inside[nearest]
            used[nearest] = True
    for n in np.flatnonzero(~used):
        inside[np.argmin(np.abs(levels - drawn.heights[n]))] |= drawn.inside[n]
    if lacking:
        warnings += (
            f"slices without a contour, interpolated between their neighbours, at {listed(lacking)} mm",
        )
    notes = (f"contours are unevenly spaced; planes interpolated between them: {uneven}",) * bool(uneven)
    return inside, notes, warnings


def _continues(region: DrawnRegion, drawn: _Planes) -> tuple[list[bool], tuple[str, ...]]:
    """Whether one body is on both sides of each gap between planes, and the gap can be interpolated; and
    warnings.

    The sections beside it overlap, and the gap is not much wider than one beside it, or one of the sections
    is no end of a body. Raises PatientError where the gap of an organ is too wide.
    """
    gaps, areas = drawn.gaps_mm, drawn.areas
    usual = _usual(gaps)
    continues: list[bool] = []
    warnings: tuple[str, ...] = ()
    for n, gap in enumerate(gaps):
        pair = drawn.inside[n : n + 2]
        shared, smaller = pair.all(axis=0).sum(), pair.sum(axis=(1, 2)).min()
        is_over = shared > 0 and shared >= LEAST_OVERLAP * smaller
        beside = np.delete(gaps[max(n - 1, 0) : n + 2], min(n, 1))
        is_near = gap <= WIDER * max(beside, default=usual)
        are_ends = _is_end(areas[n], areas[: n + 1], usual) and _is_end(areas[n + 1], areas[n + 1 :], usual)
        is_one = bool(is_over and (is_near or not are_ends))
        continues.append(is_one and gap <= MOST_GAP_MM)
        if is_one and gap > MOST_GAP_MM:
            between = " and ".join(map(drawn.place, drawn.heights[n : n + 2]))
            if region.is_organ:
                raise PatientError(
                    f"{region} has no contour between {between} mm; expected at most {MOST_GAP_MM:g} mm "
                    "without one; draw the contours "
                    "between, or make its parts regions of their own"
                )
            warnings += (f"a gap too wide to interpolate was left empty, between {between} mm",)
    return continues, warnings


def _is_end(section: float, areas: np.ndarray, usual_mm: float) -> bool:
    """Whether a section [mm^2] beside a gap may be the last of a body: the cap beyond it, of a ball with the
    largest section, is little higher than usual.

    ``areas`` are of all sections on its side; ``usual_mm`` is the usual distance of planes.
    """
    cap = np.sqrt(areas.max() / np.pi) - np.sqrt((areas.max() - section) / np.pi)
    return bool(cap <= LACKS * usual_mm)


def _interpolated(pair: np.ndarray, share: float, spacing: np.ndarray) -> np.ndarray:
    """The section (y, x) between two (2, y, x) of one body, at a share of their distance from the first."""
    x, y, _ = box_of(pair)
    below, above = (_signed_distance(np.pad(section, 1), spacing) for section in pair[:, y, x])
    between = np.zeros(pair.shape[1:], bool)
    between[y, x] = ((1 - share) * below + share * above < 0)[1:-1, 1:-1]
    return between


def _signed_distance(section: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Distance [mm] of pixel centres from the boundary of a section (y, x), negative inside."""
    sampling = spacing[1::-1]
    outside = ndimage.distance_transform_edt(~section, sampling=sampling)
    return outside - ndimage.distance_transform_edt(section, sampling=sampling)
