"""The search for a plan: candidates foreseen, then tried in headless scans of the deforming organ, and ranked."""

from collections.abc import Callable
from typing import Any

from rehearsal.planning.evolution import NEAR, Search
from rehearsal.planning.plan_file import MOST_SWEEPS
from rehearsal.planning.score import score
from rehearsal.planning.sweep_candidates import Candidate
from rehearsal.planning.trial_workers import Outcome, Workers

# Trials are gone faster than the plan will be.
TRIAL_MM_S = 60.0
# To foresee a candidate takes as long as so many trials.
FORESEEN = 5


def length_of(trials: int, speed_mm_s: float) -> int:
    """How long a plan with so many trials takes at most, in trials: what ``make_plan`` says is done adds up to it."""
    return trials + MOST_SWEEPS * (FORESEEN + length_at(speed_mm_s))


def length_at(speed_mm_s: float) -> int:
    """How long it takes to go a sweep at a speed, in trials: half of a trial's time is not of the steps on its passes."""
    return max(1, round((1 + TRIAL_MM_S / speed_mm_s) / 2))


def search(
    candidates: list[Candidate], workers: Workers, trials: int, done: Callable[[int], Any]
) -> list[Search]:
    """Search all candidates with so many trials together: a generation of each, then the better half with all the rest."""
    searches = []
    for candidate, start in zip(candidates, workers.foresee(candidates), strict=True):
        searches.append(Search(candidate, start, NEAR))
        done(FORESEEN)
    left = trials - _generation(searches, workers, trials, done)
    better = sorted(searches, key=lambda one: -one.score)[: -(-len(searches) // 2)]
    while left > 0:
        left -= _generation(better, workers, left, done)
    return searches


def _generation(active: list[Search], workers: Workers, most: int, done: Callable[[int], Any]) -> int:
    """One more generation of each, as far as trials are left; how many were made."""
    share = [most // len(active) + (number < most % len(active)) for number in range(len(active))]
    asked = [one.ask()[:count] for one, count in zip(active, share, strict=True)]
    tasks = [
        (one.candidate, one.candidate.values(shares), TRIAL_MM_S)
        for one, generation in zip(active, asked, strict=True)
        for shares in generation
    ]
    scores = []
    for outcome in workers.go(tasks):
        scores.append(score(outcome.parts))
        done(1)
    for one, generation in zip(active, asked, strict=True):
        if generation:
            one.tell(generation, scores[: len(generation)])
            scores = scores[len(generation) :]
    return len(tasks)


def ranked(
    searches: list[Search], workers: Workers, speed_mm_s: float, done: Callable[[int], Any]
) -> list[tuple[Search, Outcome]]:
    """The best of each candidate gone once more, as fast as it will be; the best of these first."""
    tried = [one for one in searches if one.trials]
    rows = []
    for one, outcome in zip(
        tried, workers.go([(each.candidate, each.values, speed_mm_s) for each in tried]), strict=True
    ):
        rows.append((one, outcome))
        done(length_at(speed_mm_s))
    return sorted(rows, key=lambda row: -score(row[1].parts))
