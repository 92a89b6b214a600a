"""Sweeps that nobody planned, to hold a planned one against: straight, row by row, and by chance."""

from collections.abc import Callable
from functools import partial

import numpy as np

from rehearsal.planning.plan_file import PlannedSweep
from rehearsal.planning.plan_poses import passes_in
from rehearsal.planning.sweep_candidates import UNPLANNED_MM, half_size, passes_needed, width_mm
from rehearsal.planning.sweep_path import SweepLayout, SweepPath, gliding, layout_towards
from rehearsal.planning.trial import Trial


def straight(trial: Trial) -> SweepPath:
    """One pass over the target's middle, straight down on the organ."""
    layout, half = _seen_from_above(trial)
    return _rows(trial, layout, half, 1)


def row_by_row(trial: Trial) -> SweepPath:
    """As many passes side by side, straight down, as the target is wide."""
    layout, half = _seen_from_above(trial)
    return _rows(trial, layout, half, passes_needed(half[0], width_mm(trial.rehearsal, layout)))


def by_chance(trial: Trial, count: int, seed: int) -> SweepPath:
    """Passes anywhere over the target, each with a heading and depth of its own, square to the surface."""
    layout, half = _seen_from_above(trial)
    chance = np.random.default_rng(seed)
    passes: list[np.ndarray] = []
    while len(passes) < count:
        aside, ahead = chance.uniform(-half, half)
        turned = layout.turned((0.0, 0.0), chance.uniform(-180.0, 180.0))
        centre = layout.centre + aside * layout.lateral + ahead * layout.ahead
        one = SweepLayout(centre, turned.outward, turned.ahead, turned.lateral)
        depth = chance.uniform(0.0, 2 * UNPLANNED_MM)
        passes += gliding(trial.rehearsal.manipulator, one, np.zeros(1), -half[1], half[1], depth, 1.0).passes
    return SweepPath(tuple(passes))


def planned(trial: Trial, sweep: PlannedSweep) -> SweepPath:
    """The sweep of a plan."""
    return SweepPath(tuple(passes_in(trial.rehearsal, sweep)))


def _seen_from_above(trial: Trial) -> tuple[SweepLayout, np.ndarray]:
    """The target's middle as the scene's press meets it, and half of its size across and along (2,) [mm]."""
    coverage, press = trial.coverage, trial.rehearsal.press
    places = coverage.voxel_centres(trial.target)
    layout = layout_towards(places.mean(axis=0), -np.array(press.direction), np.array(press.lateral))
    return layout, half_size(layout, places)


def _rows(trial: Trial, layout: SweepLayout, half: np.ndarray, count: int) -> SweepPath:
    width = width_mm(trial.rehearsal, layout)
    aside = width * (np.arange(count) - (count - 1) / 2)
    return gliding(trial.rehearsal.manipulator, layout, aside, -half[1], half[1], UNPLANNED_MM, 0.0)


UNPLANNED = {"straight": straight, "row by row": row_by_row}


def ways_by_chance(count: int, seeds: range) -> list[Callable[[Trial], SweepPath]]:
    """One for each seed, as ``Workers.go_ways`` takes them."""
    return [partial(by_chance, count=count, seed=seed) for seed in seeds]
