"""The speed-accuracy points measured by ``study trade``, their Pareto front, and the best point of it for
a budget on this machine.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from errors import UserError
from rehearsal.configuration import PRESETS, Setup, setup_of

if TYPE_CHECKING:
    from rehearsal.rehearsal import Rehearsal

# Written by ``study trade``, copied here whole.
MEASURED = Path(__file__).with_suffix(".json")
SETTINGS = ("radius_mm", "cell_mm", "stiffness", "substeps", "iterations", "relaxation_factor")
# Settings farther from every measured point than this factor in resolution times iterations have no expected
# error.
NEAR = 1.6
# The press that measures the time of a step on this machine.
TRIAL_MM, TRIAL_STEPS = 8.0, 40


class NoPoint(UserError):
    """Raised for budgets that no settings meet; the message is one line."""


@dataclass(frozen=True)
class Point:
    """Settings, median time of a step [ms] on the measuring machine, and mean bead error [mm]."""

    setup: Setup
    ms_median: float
    error_mean_mm: float
    pareto: bool


@lru_cache
def load_points() -> tuple[Point, ...]:
    """The measured points, fastest first."""
    rows = json.loads(MEASURED.read_text("utf-8"))["points"]
    points = [Point(setup_of_row(row), row["ms_median"], row["error_mean_mm"], row["pareto"]) for row in rows]
    return tuple(sorted(points, key=lambda point: point.ms_median))


def setup_of_row(row: dict[str, Any]) -> Setup:
    """The settings of a row of trade.json."""
    values = {name: row[name] for name in SETTINGS if row[name] is not None}
    return setup_of(row["model"], **values)


def preset_of(setup: Setup) -> str:
    """The name of settings among the presets; empty where they have none."""
    return next((name for name, preset in PRESETS[setup.model].items() if preset == setup), "")


def pareto(ms: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Which (n,) of some points no other is at least as good as in both times (n,) and errors (n,), and
    better in one.
    """
    no_worse = (ms[:, None] <= ms) & (error[:, None] <= error)
    better = (ms[:, None] < ms) | (error[:, None] < error)
    return np.logical_not((no_worse & better).any(axis=0))


def front_of(points: Sequence[Point], model: str | None) -> list[Point]:
    """The front, cheapest first: of all models, or of one alone."""
    if model is None:
        return [point for point in points if point.pareto]
    own = [point for point in points if point.setup.model == model]
    best = pareto(
        np.array([point.ms_median for point in own]), np.array([point.error_mean_mm for point in own])
    )
    return [point for point, is_best in zip(own, best, strict=True) if is_best]


def expected_error_mm(points: Sequence[Point], setup: Setup) -> float | None:
    """The mean error of the nearest settings that were measured; None where none is near.

    Half the resolution and double the iterations are equally far.
    """

    def away(point: Point) -> float:
        other = point.setup
        size = np.log(setup.size_mm / other.size_mm) + stiffness_of(setup) - stiffness_of(other)
        iterations = np.log(setup.substeps * setup.iterations / (other.substeps * other.iterations))
        return abs(size) + abs(iterations) + 0.1 * abs(setup.relaxation_factor - other.relaxation_factor)

    def stiffness_of(setup: Setup) -> float:
        return getattr(setup.tissue, "stiffness", 0.0)

    own = [point for point in points if point.setup.model == setup.model]
    nearest = min(own, key=away, default=None)
    return None if nearest is None or away(nearest) > np.log(NEAR) else nearest.error_mean_mm


def choose_within_budget(
    front: list[Point], build: Callable[[Setup], "Rehearsal"], budget_ms: float | None, error_mm: float | None
) -> tuple["Rehearsal", Point, float]:
    """A rehearsal within the budgets, its point, and the time of a step measured here [ms].

    With a time alone it is the truest that keeps it, with an error the fastest that keeps that. The front's
    times are another machine's and another organ's: a first trial says how much longer steps take here.
    Raises NoPoint.
    """
    front = sorted(front, key=lambda point: point.ms_median)
    allowed = [point for point in front if error_mm is None or point.error_mean_mm <= error_mm]
    if not allowed:
        best = min(point.error_mean_mm for point in front)
        raise NoPoint(
            f"--error-mm {error_mm:g}: the least mean error that was measured is {best:.3f} mm; ask for that "
            "or more"
        )

    def tried(at: int) -> tuple["Rehearsal", float]:
        rehearsal = build(allowed[at].setup)
        return rehearsal, trial_ms(rehearsal)

    if budget_ms is None:
        rehearsal, here_ms = tried(0)
        return rehearsal, allowed[0], here_ms
    times = np.array([point.ms_median for point in allowed])
    guess = _last(times <= budget_ms)
    rehearsal, here_ms = tried(guess)
    at = _last(here_ms / times[guess] * times <= budget_ms)
    if at != guess:
        rehearsal, here_ms = tried(at)
    while here_ms > budget_ms:
        if at == 0:
            raise NoPoint(
                f"--budget-ms {budget_ms:g}: a step of {described(allowed[0].setup)} takes {here_ms:.2f} ms "
                "here, and none "
                f"that may be chosen is faster; ask for that or more"
            )
        at -= 1
        rehearsal, here_ms = tried(at)
    return rehearsal, allowed[at], here_ms


def _last(true: np.ndarray) -> int:
    """Index of the last that is true; 0 where none is."""
    return int(np.flatnonzero(true)[-1]) if true.any() else 0


def trial_ms(rehearsal: "Rehearsal") -> float:
    """Median time of a step here [ms], over a press; the rehearsal is as it was afterwards."""
    from rehearsal.stopwatch import timed

    ms: list[float] = []
    for depth in np.linspace(0.0, TRIAL_MM, TRIAL_STEPS):
        pose = rehearsal.pose_at_depth(float(depth))
        timed(lambda: rehearsal.advance(pose), ms)
    rehearsal.reset()
    return float(np.median(ms))


def described(setup: Setup) -> str:
    """Settings as text."""
    size = f"{setup.tissue.piece_name} of {setup.size_mm:g} mm"
    return f"{setup.model}, {size}, {setup.substeps} x {setup.iterations} iterations"
