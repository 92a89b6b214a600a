"""Baselines for a planned sweep: straight, row by row, and random."""

import numpy as np

from rehearsal.planning.plan_file import PlannedSweep
from rehearsal.planning.plan_guidance import passes_in
from rehearsal.planning.sweep_candidates import (
    DEFAULT_DEPTH_MM,
    half_extent_mm,
    image_width_mm,
    passes_needed,
)
from rehearsal.planning.sweep_path import SweepLayout, SweepPath, layout_towards, sliding
from rehearsal.planning.sweep_trial import Trial


def straight(trial: Trial) -> SweepPath:
    """One pass over the middle of the target, pressed straight down on the organ."""
    layout, half = _seen_from_above(trial)
    return _rows(trial, layout, half, 1)


def row_by_row(trial: Trial) -> SweepPath:
    """Passes side by side, pressed straight down, that cover the width of the target."""
    layout, half = _seen_from_above(trial)
    return _rows(trial, layout, half, passes_needed(half[0], image_width_mm(trial.rehearsal, layout)))


def random_sweep(trial: Trial, count: int, seed: int) -> SweepPath:
    """Random passes over the target, each with its own heading and depth, perpendicular to the surface."""
    layout, half = _seen_from_above(trial)
    random = np.random.default_rng(seed)
    passes: list[np.ndarray] = []
    while len(passes) < count:
        aside, ahead = random.uniform(-half, half)
        turned = layout.turned((0.0, 0.0), random.uniform(-180.0, 180.0))
        centre = layout.centre + aside * layout.lateral + ahead * layout.ahead
        one = SweepLayout(centre, turned.outward, turned.ahead, turned.lateral)
        depth = random.uniform(0.0, 2 * DEFAULT_DEPTH_MM)
        passes += sliding(trial.rehearsal.manipulator, one, np.zeros(1), -half[1], half[1], depth, 1.0).passes
    return SweepPath(tuple(passes))


def planned(trial: Trial, sweep: PlannedSweep) -> SweepPath:
    """The sweep of a plan."""
    return SweepPath(tuple(passes_in(trial.rehearsal, sweep)))


def _seen_from_above(trial: Trial) -> tuple[SweepLayout, np.ndarray]:
    """A layout over the target's middle along the scene's press, and half of the target's size across and along (2,) [mm]."""
    coverage, press = trial.coverage, trial.rehearsal.press
    places = coverage.voxel_centres(trial.target)
    layout = layout_towards(places.mean(axis=0), -np.array(press.direction), np.array(press.lateral))
    return layout, half_extent_mm(layout, places)


def _rows(trial: Trial, layout: SweepLayout, half: np.ndarray, count: int) -> SweepPath:
    width = image_width_mm(trial.rehearsal, layout)
    aside = width * (np.arange(count) - (count - 1) / 2)
    return sliding(trial.rehearsal.manipulator, layout, aside, -half[1], half[1], DEFAULT_DEPTH_MM, 0.0)


UNPLANNED = {"straight": straight, "row by row": row_by_row}
