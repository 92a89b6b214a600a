"""The speed-accuracy points measured by ``study trade``, and their Pareto front."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rehearsal.configuration import PRESETS, Setup, setup_of

# Written by ``study trade``, copied here whole.
MEASURED = Path(__file__).with_name("points.json")
SETTINGS = ("radius_mm", "cell_mm", "stiffness", "substeps", "iterations", "relaxation_factor")
# Settings farther from every measured point than this factor in resolution times iterations have no expected error.
NEAR = 1.6


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
    found = [Point(setup_of_row(row), row["ms_median"], row["error_mean_mm"], row["pareto"]) for row in rows]
    return tuple(sorted(found, key=lambda point: point.ms_median))


def setup_of_row(row: dict[str, Any]) -> Setup:
    """The settings of a row of trade.json."""
    given = {name: row[name] for name in SETTINGS if row[name] is not None}
    return setup_of(row["model"], **given)


def preset_of(setup: Setup) -> str:
    """The name of settings among the presets; empty where they have none."""
    return next((name for name, preset in PRESETS[setup.model].items() if preset == setup), "")


def pareto(ms: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Which (n,) of some points no other is at least as good as in both times (n,) and errors (n,), and better in one."""
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
