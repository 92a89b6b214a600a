"""A plan made: candidates searched on the deforming organ, gone slowly once more, and ranked."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from rehearsal.planning.evolution import SEED, Search
from rehearsal.planning.plan_file import Plan, PlanError, PlannedSweep
from rehearsal.planning.score import in_words, points, score, why
from rehearsal.planning.search import ranked, search
from rehearsal.planning.trial_workers import Outcome, Problem, Workers
from scenes.anatomy import fingerprint
from version import VERSION

DIGITS = 6


def make_plan(
    problem: Problem, workers: Workers, speed_mm_s: float, trials: int, done: Callable[[int], Any]
) -> Plan:
    """The plan that solves a problem. Raises PlanError where no way is found.

    ``done`` is told of each part how long it was, in trials (``length_of``): first of 0, where the search begins.
    """
    space = workers.search_space()
    done(0)
    searches = search(space.candidates, workers, trials, done)
    rows = [row for row in ranked(searches, workers, speed_mm_s, done) if row[1].passes]
    if not rows or rows[0][1].parts.reachable < 1.0:
        raise PlanError(
            "no sweep was found that an instrument through the trocar can hold all along; move the trocar, widen its cone, "
            "or give the search more --trials"
        )
    return Plan(
        version=VERSION,
        anatomy=fingerprint(problem.anatomy),
        target=problem.target,
        margin_mm=problem.margin_mm,
        speed_mm_s=speed_mm_s,
        probe=problem.probe.model_dump(by_alias=True, mode="json"),
        trocar=problem.trocar,
        model=space.model,
        seed=SEED,
        why=_reasons(rows),
        sweeps=[_sweep(*row) for row in rows],
    )


def _reasons(rows: list[tuple[Search, Outcome]]) -> list[str]:
    first = rows[0][1].parts
    said = [f"The first sweep is {_name(*rows[0])}, with {score(first):.1f} points: {in_words(first)}."]
    for one, outcome in rows[1:]:
        parts = outcome.parts
        said.append(
            f"It comes before {_name(one, outcome)}, with {score(parts):.1f} points: {why(first, parts)}."
        )
    return said


def _name(one: Search, outcome: Outcome) -> str:
    return one.candidate.named(len(outcome.passes))


def _sweep(one: Search, outcome: Outcome) -> PlannedSweep:
    return PlannedSweep(
        name=_name(one, outcome),
        score=round(score(outcome.parts), DIGITS),
        parts=_rounded(asdict(outcome.parts)),
        points=_rounded(points(outcome.parts)),
        values=_rounded(one.values),
        trials=one.trials,
        passes=[np.round(each, DIGITS).tolist() for each in outcome.passes],
    )


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, DIGITS) for name, value in values.items()}
