"""The kinds of sweep that a plan chooses from; each has a few parameters with ranges, which define a path over the organ."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rehearsal.planning.instrument_reach import InstrumentReach
from rehearsal.planning.sweep_path import (
    FAR_MM,
    SweepLayout,
    SweepPath,
    layout_towards,
    pose_over,
    sliding,
    tilting,
)
from rehearsal.rehearsal import Rehearsal
from ultrasound.coverage import Coverage
from ultrasound.probe_manipulator import ProbeManipulator

# Directions sampled around the organ; the smallest cosine of one to "above"; the smallest angle between two sides.
DIRECTIONS, LEAST_COSINE, APART_DEG = 300, 0.1, 20.0
MOST_PASSES = 6
# Depth of an unplanned sweep below the settled surface: the middle of the range of a scene's press.
DEFAULT_DEPTH_MM = 3.0


class ParameterRange(NamedTuple):
    """The range and the default of a candidate's parameter."""

    low: float
    high: float
    start: float


@dataclass(frozen=True)
class SweepCandidate:
    """``motion`` is "slide" or "tilt", ``count`` the number of passes, ``layout`` their frame before the parameters rotate it."""

    side: str
    motion: str
    count: int
    layout: SweepLayout
    ranges: dict[str, ParameterRange]

    def name(self, count: int) -> str:
        """The name of its sweep with so many passes."""
        if self.motion == "slide":
            return f"{'one pass' if count == 1 else f'{count} passes'} {self.side}"
        return f"tilting in {'one place' if count == 1 else f'{count} places'} {self.side}"

    def start(self) -> np.ndarray:
        """The default parameters (n,), scaled to 0 to 1."""
        return np.array([(r.start - r.low) / (r.high - r.low) for r in self.ranges.values()])

    def values(self, scaled: np.ndarray) -> dict[str, float]:
        """Name -> value of parameters (n,) that are scaled to 0 to 1; others are clipped."""
        clipped = np.clip(scaled, 0.0, 1.0)
        pairs = zip(self.ranges.items(), clipped, strict=True)
        return {name: float(r.low + share * (r.high - r.low)) for (name, r), share in pairs}

    def path(self, manipulator: ProbeManipulator, values: dict[str, float]) -> SweepPath:
        """The path that the parameters define."""
        layout = self.layout.turned((values["lean_deg"], values["lean_aside_deg"]), values["heading_deg"])
        rows = np.arange(self.count) - (self.count - 1) / 2
        aside = values["aside_mm"] + values.get("apart_mm", 0.0) * rows
        if self.motion == "slide":
            along = values["start_mm"], values["end_mm"]
            return sliding(manipulator, layout, aside, *along, values["depth_mm"], values["follow"])
        angles = values["first_deg"], values["last_deg"]
        return tilting(manipulator, layout, aside, values["ahead_mm"], angles, values["depth_mm"])


def candidates_of(
    rehearsal: Rehearsal, coverage: Coverage, target: str, reach: InstrumentReach
) -> list[SweepCandidate]:
    """Candidates that may cover a target: from above and from the side nearest to it, sliding and tilting."""
    places = coverage.voxel_centres(target)
    centre = places.mean(axis=0)
    above = -np.array(rehearsal.press.direction)
    lateral = np.array(rehearsal.press.lateral)
    outwards = {"from above": above}
    nearest = nearest_side(rehearsal.manipulator, centre, above, reach, lateral)
    if nearest is not None and nearest @ above < np.cos(np.radians(APART_DEG)):
        outwards["from the nearest side"] = nearest
    found = []
    for side, outward in outwards.items():
        layout = layout_towards(centre, outward, lateral)
        half = half_extent_mm(layout, places)
        width = image_width_mm(rehearsal, layout)
        count = passes_needed(half[0], width)
        found.append(_sliding_candidate(side, count, layout, half, width))
        if side == list(outwards)[-1]:
            if count < MOST_PASSES:
                found.append(_sliding_candidate(side, count + 1, layout, half, width))
            found.append(_tilting_candidate(side, count, layout, half, width))
    return found


def half_extent_mm(layout: SweepLayout, places: np.ndarray) -> np.ndarray:
    """The largest distance (2,) of places (n, 3) from a layout's centre, across and along the passes."""
    return np.abs((places - layout.centre) @ np.column_stack([layout.lateral, layout.ahead])).max(axis=0)


def image_width_mm(rehearsal: Rehearsal, layout: SweepLayout) -> float:
    """The width of the image at a layout's centre, with the probe on the surface above it."""
    top = rehearsal.manipulator.ray_hit(layout.centre + FAR_MM * layout.outward, -layout.outward)
    depth = 0.0 if top is None else float((top - layout.centre) @ layout.outward)
    probe = rehearsal.probe
    return float(probe.number_of_scanlines * probe.line_spacing_mm(np.array([max(depth, 0.0)]))[0])


def passes_needed(half_mm: float, width_mm: float) -> int:
    """How many passes with images of a width cover a distance to either side."""
    return int(np.clip(np.ceil(2 * half_mm / width_mm), 1, MOST_PASSES))


def nearest_side(
    manipulator: ProbeManipulator,
    centre: np.ndarray,
    above: np.ndarray,
    reach: InstrumentReach,
    lateral: np.ndarray,
) -> np.ndarray | None:
    """The direction (3,) from a place to the nearest surface where a probe can be placed; None where there is none."""
    least, found = np.inf, None
    for outward in directions(DIRECTIONS):
        place = manipulator.ray_hit(centre + FAR_MM * outward, -outward)
        if outward @ above < LEAST_COSINE or place is None:
            continue
        distance = float((place - centre) @ outward)
        if distance < least:
            pose = pose_over(manipulator, layout_towards(centre, outward, lateral), 0.0, 0.0, 0.0, 1.0)
            if pose is not None and reach(pose[None])[0]:
                least, found = distance, outward
    return found


def directions(count: int) -> np.ndarray:
    """Unit vectors (n, 3) evenly over a sphere: a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def _sliding_candidate(
    side: str, count: int, layout: SweepLayout, half: np.ndarray, width: float
) -> SweepCandidate:
    """Parallel passes; the defaults are straight rows."""
    far = half[1]
    own = {
        "start_mm": ParameterRange(-1.4 * far, 0.0, -far),
        "end_mm": ParameterRange(0.0, 1.4 * far, far),
        "follow": ParameterRange(0.0, 1.0, 0.0),
        "depth_mm": ParameterRange(0.0, 6.0, DEFAULT_DEPTH_MM),
    }
    return SweepCandidate(side, "slide", count, layout, _ranges(own, half, count, width))


def _tilting_candidate(
    side: str, count: int, layout: SweepLayout, half: np.ndarray, width: float
) -> SweepCandidate:
    own = {
        "ahead_mm": ParameterRange(-half[1], half[1], 0.0),
        "first_deg": ParameterRange(-45.0, 0.0, -30.0),
        "last_deg": ParameterRange(0.0, 45.0, 30.0),
        "depth_mm": ParameterRange(0.0, 6.0, 1.5),
    }
    return SweepCandidate(side, "tilt", count, layout, _ranges(own, half, count, width))


def _ranges(
    own: dict[str, ParameterRange], half: np.ndarray, count: int, width: float
) -> dict[str, ParameterRange]:
    """A motion's own parameters between those that all candidates have, and the spacing of several passes."""
    layout = {
        "lean_deg": ParameterRange(-40.0, 40.0, 0.0),
        "lean_aside_deg": ParameterRange(-40.0, 40.0, 0.0),
        "heading_deg": ParameterRange(-90.0, 90.0, 0.0),
        "aside_mm": ParameterRange(-half[0], half[0], 0.0),
    }
    spacing = {} if count == 1 else {"apart_mm": ParameterRange(0.4 * width, 1.1 * width, width)}
    return layout | own | spacing
