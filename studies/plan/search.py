"""The search for a plan: candidates foreseen, then tried in headless scans of the deforming organ, and ranked."""

from collections.abc import Callable
from typing import Any

from studies.plan.candidate import Candidate
from studies.plan.evolution import NEAR, Search
from studies.plan.score import score
from studies.plan.workers import Outcome, Workers

# The share of all trials in which the candidates are compared; the better half of them has the rest.
FIRST = 0.5
# Trials are gone faster than the plan will be.
TRIAL_MM_S = 60.0


def search(
    candidates: list[Candidate], workers: Workers, trials: int, done: Callable[[], Any]
) -> list[Search]:
    """Search all candidates with so many trials together: first all of them, then the better half."""
    searches = []
    for candidate, start in zip(candidates, workers.foresee(candidates), strict=True):
        searches.append(Search(candidate, start, NEAR))
        done()
    active, left = searches, trials
    while left > 0:
        if len(active) == len(searches) and left <= (1 - FIRST) * trials:
            active = sorted(searches, key=lambda one: -one.score)[: -(-len(searches) // 2)]
        left -= _generation(active, workers, left, done)
    return searches


def _generation(active: list[Search], workers: Workers, most: int, done: Callable[[], Any]) -> int:
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
        done()
    for one, generation in zip(active, asked, strict=True):
        if generation:
            one.tell(generation, scores[: len(generation)])
            scores = scores[len(generation) :]
    return len(tasks)


def ranked(
    searches: list[Search], workers: Workers, speed_mm_s: float, done: Callable[[], Any]
) -> list[tuple[Search, Outcome]]:
    """The best of each candidate gone once more, as fast as it will be; the best of these first."""
    tried = [one for one in searches if one.trials]
    rows = []
    for one, outcome in zip(
        tried, workers.go([(each.candidate, each.values, speed_mm_s) for each in tried]), strict=True
    ):
        rows.append((one, outcome))
        done()
    return sorted(rows, key=lambda row: -score(row[1].parts))
