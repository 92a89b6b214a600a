"""Kinds of sweep that a plan chooses among: each a few numbers, with their ranges, that make a way over the organ."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rehearsal.planning.instrument_reach import Reach
from rehearsal.planning.sweep_path import (
    FAR_MM,
    SweepLayout,
    SweepPath,
    gliding,
    layout_towards,
    pose_over,
    tilting,
)
from rehearsal.rehearsal import Rehearsal
from ultrasound.coverage import Coverage
from ultrasound.probe_manipulator import ProbeManipulator

# Sides of the organ that are looked at, no farther round than this from above (its cosine), and how much two differ.
SIDES, ROUND, APART_DEG = 300, 0.1, 20.0
MOST_PASSES = 6
# How deep a sweep presses that nobody planned: in the middle of what a scene's press begins with.
UNPLANNED_MM = 3.0


class Quantity(NamedTuple):
    """A number of a candidate: its range, and where the search begins."""

    low: float
    high: float
    start: float


@dataclass(frozen=True)
class Candidate:
    """``motion`` is "glide" or "tilt", ``count`` how many passes; ``layout`` is where they lie before they are leant and turned."""

    side: str
    motion: str
    count: int
    layout: SweepLayout
    quantities: dict[str, Quantity]

    def named(self, count: int) -> str:
        """What a sweep of it is called that has so many passes."""
        if self.motion == "glide":
            return f"{'one pass' if count == 1 else f'{count} passes'} {self.side}"
        return f"tilting in {'one place' if count == 1 else f'{count} places'} {self.side}"

    def start(self) -> np.ndarray:
        """Where the search begins, shares (n,) of the ranges."""
        return np.array([(q.start - q.low) / (q.high - q.low) for q in self.quantities.values()])

    def values(self, shares: np.ndarray) -> dict[str, float]:
        """Name -> number, of shares (n,) of the ranges."""
        inside = np.clip(shares, 0.0, 1.0)
        pairs = zip(self.quantities.items(), inside, strict=True)
        return {name: float(q.low + share * (q.high - q.low)) for (name, q), share in pairs}

    def way(self, manipulator: ProbeManipulator, values: dict[str, float]) -> SweepPath:
        """The way that the numbers make."""
        layout = self.layout.turned((values["lean_deg"], values["lean_aside_deg"]), values["heading_deg"])
        rows = np.arange(self.count) - (self.count - 1) / 2
        aside = values["aside_mm"] + values.get("apart_mm", 0.0) * rows
        if self.motion == "glide":
            along = values["start_mm"], values["end_mm"]
            return gliding(manipulator, layout, aside, *along, values["depth_mm"], values["follow"])
        angles = values["first_deg"], values["last_deg"]
        return tilting(manipulator, layout, aside, values["ahead_mm"], angles, values["depth_mm"])


def candidates_of(rehearsal: Rehearsal, coverage: Coverage, target: str, reach: Reach) -> list[Candidate]:
    """What may cover a target: from above and from the side where it lies shallowest, gliding and tilting."""
    places = coverage.voxel_centres(target)
    centre = places.mean(axis=0)
    above = -np.array(rehearsal.press.direction)
    outwards = {"from above": above}
    nearest = shallowest(rehearsal.manipulator, centre, above, reach, np.array(rehearsal.press.lateral))
    if nearest is not None and nearest @ above < np.cos(np.radians(APART_DEG)):
        outwards["from the nearest side"] = nearest
    found = []
    for side, outward in outwards.items():
        layout = layout_towards(centre, outward, np.array(rehearsal.press.lateral))
        half = half_size(layout, places)
        width = width_mm(rehearsal, layout)
        count = passes_needed(half[0], width)
        found.append(_glide(side, count, layout, half, width))
        if side == list(outwards)[-1]:
            if count < MOST_PASSES:
                found.append(_glide(side, count + 1, layout, half, width))
            found.append(_rock(side, count, layout, half, width))
    return found


def half_size(layout: SweepLayout, places: np.ndarray) -> np.ndarray:
    """How far places (n, 3) lie across and along from a layout's centre, at most (2,) [mm]."""
    return np.abs((places - layout.centre) @ np.column_stack([layout.lateral, layout.ahead])).max(axis=0)


def width_mm(rehearsal: Rehearsal, layout: SweepLayout) -> float:
    """How wide the picture is at a layout's centre, where the probe looks on it from outside."""
    top = rehearsal.manipulator.ray_hit(layout.centre + FAR_MM * layout.outward, -layout.outward)
    depth = 0.0 if top is None else float((top - layout.centre) @ layout.outward)
    probe = rehearsal.probe
    return float(probe.number_of_scanlines * probe.line_spacing_mm(np.array([max(depth, 0.0)]))[0])


def passes_needed(half_mm: float, width: float) -> int:
    """How many passes of a picture so wide cover so much to either side."""
    return int(np.clip(np.ceil(2 * half_mm / width), 1, MOST_PASSES))


def shallowest(
    manipulator: ProbeManipulator, centre: np.ndarray, above: np.ndarray, reach: Reach, lateral: np.ndarray
) -> np.ndarray | None:
    """The direction (3,) from a place to the nearest surface on which a probe can be set; None where there is none."""
    best, found = np.inf, None
    for outward in directions(SIDES):
        place = manipulator.ray_hit(centre + FAR_MM * outward, -outward)
        if outward @ above < ROUND or place is None:
            continue
        distance = float((place - centre) @ outward)
        if distance < best:
            pose = pose_over(manipulator, layout_towards(centre, outward, lateral), 0.0, 0.0, 0.0, 1.0)
            if pose is not None and reach(pose[None])[0]:
                best, found = distance, outward
    return found


def directions(count: int) -> np.ndarray:
    """Unit vectors (n, 3) evenly over a sphere: a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def _about(half: np.ndarray) -> dict[str, Quantity]:
    return {
        "lean_deg": Quantity(-40.0, 40.0, 0.0),
        "lean_aside_deg": Quantity(-40.0, 40.0, 0.0),
        "heading_deg": Quantity(-90.0, 90.0, 0.0),
        "aside_mm": Quantity(-half[0], half[0], 0.0),
    }


def _apart(count: int, width: float) -> dict[str, Quantity]:
    return {} if count == 1 else {"apart_mm": Quantity(0.4 * width, 1.1 * width, width)}


def _glide(side: str, count: int, layout: SweepLayout, half: np.ndarray, width: float) -> Candidate:
    """Passes side by side; it begins with the straight rows that anyone would go."""
    far = half[1]
    own = {
        "start_mm": Quantity(-1.4 * far, 0.0, -far),
        "end_mm": Quantity(0.0, 1.4 * far, far),
        "follow": Quantity(0.0, 1.0, 0.0),
        "depth_mm": Quantity(0.0, 6.0, UNPLANNED_MM),
    }
    return Candidate(side, "glide", count, layout, _about(half) | own | _apart(count, width))


def _rock(side: str, count: int, layout: SweepLayout, half: np.ndarray, width: float) -> Candidate:
    own = {
        "ahead_mm": Quantity(-half[1], half[1], 0.0),
        "first_deg": Quantity(-45.0, 0.0, -30.0),
        "last_deg": Quantity(0.0, 45.0, 30.0),
        "depth_mm": Quantity(0.0, 6.0, 1.5),
    }
    return Candidate(side, "tilt", count, layout, _about(half) | own | _apart(count, width))
