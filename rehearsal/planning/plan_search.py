"""The search for a plan: candidates started on the rigid surrogate, optimised in trials on the deforming organ, and ranked."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from rehearsal.planning.candidate_search import SEED, TRIAL_SIGMA, CandidateSearch
from rehearsal.planning.plan_file import MOST_SWEEPS, Plan, PlanError, PlannedSweep
from rehearsal.planning.sweep_candidates import SweepCandidate
from rehearsal.planning.sweep_score import in_words, points, score, why_better
from rehearsal.planning.trial_workers import PlanningProblem, TrialResult, TrialWorkers
from scenes.anatomy import fingerprint
from version import VERSION

# Trials of the search are faster than the planned sweep.
TRIAL_MM_S = 60.0
# The surrogate search of a candidate takes as long as this many trials.
SURROGATE_TRIALS = 5
DIGITS = 6
Progress = Callable[[int], Any]


def make_plan(
    problem: PlanningProblem, workers: TrialWorkers, speed_mm_s: float, trials: int, progress: Progress
) -> Plan:
    """Search a plan for a problem. Raises PlanError where no sweep is reachable.

    ``progress`` is called with 0 when the search begins, then with the work done, in trials; the sum is ``total_work``.
    """
    space = workers.search_space()
    progress(0)
    searches = search(space.candidates, workers, trials, progress)
    rows = [row for row in ranked(searches, workers, speed_mm_s, progress) if row[1].passes]
    if not rows or rows[0][1].terms.reachable < 1.0:
        raise PlanError(
            "no sweep was found that an instrument through the trocar can hold at all poses; move the trocar, widen its cone, "
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


def total_work(trials: int, speed_mm_s: float) -> int:
    """The work of ``make_plan`` at most, in trials."""
    return trials + MOST_SWEEPS * (SURROGATE_TRIALS + work_at(speed_mm_s))


def work_at(speed_mm_s: float) -> int:
    """The work of one sweep at a speed, in trials: half of a trial's time does not depend on the speed."""
    return max(1, round((1 + TRIAL_MM_S / speed_mm_s) / 2))


def search(
    candidates: list[SweepCandidate], workers: TrialWorkers, trials: int, progress: Progress
) -> list[CandidateSearch]:
    """Search all candidates with a total of trials: one generation of each, then the better half with the rest."""
    searches = []
    for candidate, start in zip(candidates, workers.surrogate_optima(candidates), strict=True):
        searches.append(CandidateSearch(candidate, start, TRIAL_SIGMA))
        progress(SURROGATE_TRIALS)
    left = trials - _generation(searches, workers, trials, progress)
    better = sorted(searches, key=lambda one: -one.score)[: -(-len(searches) // 2)]
    while left > 0:
        left -= _generation(better, workers, left, progress)
    return searches


def _generation(active: list[CandidateSearch], workers: TrialWorkers, most: int, progress: Progress) -> int:
    """Run one generation of each search, with at most so many trials; return how many were run."""
    share = [most // len(active) + (number < most % len(active)) for number in range(len(active))]
    asked = [one.ask()[:count] for one, count in zip(active, share, strict=True)]
    tasks = [
        (one.candidate, one.candidate.values(scaled), TRIAL_MM_S)
        for one, generation in zip(active, asked, strict=True)
        for scaled in generation
    ]
    scores = []
    for result in workers.try_candidates(tasks):
        scores.append(score(result.terms))
        progress(1)
    for one, generation in zip(active, asked, strict=True):
        if generation:
            one.tell(generation, scores[: len(generation)])
            scores = scores[len(generation) :]
    return len(tasks)


def ranked(
    searches: list[CandidateSearch], workers: TrialWorkers, speed_mm_s: float, progress: Progress
) -> list[tuple[CandidateSearch, TrialResult]]:
    """The best of each candidate, tried once more at the planned speed; highest score first."""
    tried = [one for one in searches if one.trials]
    tasks = [(one.candidate, one.values, speed_mm_s) for one in tried]
    rows = []
    for one, result in zip(tried, workers.try_candidates(tasks), strict=True):
        rows.append((one, result))
        progress(work_at(speed_mm_s))
    return sorted(rows, key=lambda row: -score(row[1].terms))


def _reasons(rows: list[tuple[CandidateSearch, TrialResult]]) -> list[str]:
    first = rows[0][1].terms
    lines = [f"The first sweep is {_name(*rows[0])}, with {score(first):.1f} points: {in_words(first)}."]
    for one, result in rows[1:]:
        name, terms = _name(one, result), result.terms
        lines.append(f"It comes before {name}, with {score(terms):.1f} points: {why_better(first, terms)}.")
    return lines


def _name(one: CandidateSearch, result: TrialResult) -> str:
    return one.candidate.name(len(result.passes))


def _sweep(one: CandidateSearch, result: TrialResult) -> PlannedSweep:
    return PlannedSweep(
        name=_name(one, result),
        score=round(score(result.terms), DIGITS),
        parts=_rounded(asdict(result.terms)),
        points=_rounded(points(result.terms)),
        values=_rounded(one.values),
        trials=one.trials,
        passes=[np.round(each, DIGITS).tolist() for each in result.passes],
    )


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, DIGITS) for name, value in values.items()}
