"""Settings for a budget of time or error: the best point of the Pareto front on this machine."""

from collections.abc import Callable

import numpy as np

from rehearsal.configuration import Setup
from rehearsal.rehearsal import Rehearsal
from rehearsal.speed_accuracy.pareto_front import Point
from rehearsal.stopwatch import timed

# The press that measures the time of a step on this machine.
TRIAL_MM, TRIAL_STEPS = 8.0, 40


class NoPoint(ValueError):
    """Raised for budgets that no settings meet; the message is one line."""


def choose(
    front: list[Point], build: Callable[[Setup], Rehearsal], budget_ms: float | None, error_mm: float | None
) -> tuple[Rehearsal, Point, float]:
    """A rehearsal within the budgets, its point, and the time of a step measured here [ms].

    With a time alone it is the truest that keeps it, with an error the fastest that keeps that. The front's times are
    another machine's and another organ's: a first trial says how much longer steps take here. Raises NoPoint.
    """
    front = sorted(front, key=lambda point: point.ms_median)
    allowed = [point for point in front if error_mm is None or point.error_mean_mm <= error_mm]
    if not allowed:
        best = min(point.error_mean_mm for point in front)
        raise NoPoint(
            f"--error-mm {error_mm:g}: the least mean error that was measured is {best:.3f} mm; ask for that or more"
        )
    if budget_ms is None:
        rehearsal = build(allowed[0].setup)
        return rehearsal, allowed[0], trial_ms(rehearsal)
    times = np.array([point.ms_median for point in allowed])
    at = _last(times <= budget_ms)
    rehearsal = build(allowed[at].setup)
    here_ms = trial_ms(rehearsal)
    wanted = _last(here_ms / times[at] * times <= budget_ms)
    while wanted != at or here_ms > budget_ms:
        if wanted == at:
            if at == 0:
                raise NoPoint(
                    f"--budget-ms {budget_ms:g}: a step of {described(allowed[0].setup)} takes {here_ms:.2f} ms here, and none "
                    f"that may be chosen is faster; ask for that or more"
                )
            wanted = at - 1
        at = wanted
        rehearsal = build(allowed[at].setup)
        here_ms = trial_ms(rehearsal)
    return rehearsal, allowed[at], here_ms


def _last(true: np.ndarray) -> int:
    """Index of the last that is true; 0 where none is."""
    return int(np.flatnonzero(true)[-1]) if true.any() else 0


def trial_ms(rehearsal: Rehearsal) -> float:
    """Median time of a step here [ms], over a press; the rehearsal is as it was afterwards."""
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
