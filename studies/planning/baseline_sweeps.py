"""Baselines for a planned sweep: straight, row by row, and random."""

import numpy as np

from rehearsal.planning.pass_kinds import DEFAULT_DEPTH_MM, target_from
from rehearsal.planning.plan_file import PlannedSweep
from rehearsal.planning.plan_guidance import passes_in
from rehearsal.planning.sweep_path import sliding, turned
from rehearsal.planning.sweep_trial import Trial
from ultrasound.probe_manipulator import rigid


def straight(trial: Trial) -> list[np.ndarray]:
    """One pass over the middle of the target, pressed straight down on the organ."""
    return _rows(trial, 1)


def row_by_row(trial: Trial) -> list[np.ndarray]:
    """Passes side by side, pressed straight down, that cover the width of the target."""
    return _rows(trial, None)


def random_sweep(trial: Trial, count: int, seed: int) -> list[np.ndarray]:
    """Random passes over the target, each with its own heading and depth, perpendicular to the surface."""
    frame, half, _, _ = target_from(trial, -np.array(trial.case.press.direction))
    random = np.random.default_rng(seed)
    passes: list[np.ndarray] = []
    while len(passes) < count:
        aside, ahead = random.uniform(-half, half)
        rotated = turned(frame, (0.0, 0.0), random.uniform(-180.0, 180.0))
        one = rigid(rotated[:3, :3], frame[:3, 3] + aside * frame[:3, 0] + ahead * frame[:3, 1])
        depth = random.uniform(0.0, 2 * DEFAULT_DEPTH_MM)
        passes += sliding(trial.manipulator, one, np.zeros(1), -half[1], half[1], depth, 1.0)
    return passes


def planned(trial: Trial, sweep: PlannedSweep) -> list[np.ndarray]:
    """The sweep of a plan."""
    return passes_in(trial.case, sweep)


def _rows(trial: Trial, count: int | None) -> list[np.ndarray]:
    """So many passes side by side, or as many as the target is wide, along the scene's press."""
    frame, half, width, needed = target_from(trial, -np.array(trial.case.press.direction))
    count = count or needed
    aside = width * (np.arange(count) - (count - 1) / 2)
    return sliding(trial.manipulator, frame, aside, -half[1], half[1], DEFAULT_DEPTH_MM, 0.0)


UNPLANNED = {"straight": straight, "row by row": row_by_row}
