"""The search for a plan: CMA-ES over the numbers of each candidate, every trial a headless scan of the deforming organ."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cma
import numpy as np

from studies.plan.candidate import Candidate
from studies.plan.score import score
from studies.plan.workers import Gone, Workers

SEED = 20161130
# The first steps are this share of the ranges; trials in a generation.
SIGMA, GENERATION = 0.15, 8
# The share of all trials in which the candidates are compared; the better half of them has the rest.
FIRST = 0.5
# Trials are gone faster than the plan will be.
TRIAL_MM_S = 40.0


@dataclass
class Search:
    """One candidate's search, the best of it so far; the same trials give the same."""

    candidate: Candidate
    values: dict[str, float] = field(default_factory=dict)
    score: float = -np.inf
    trials: int = 0

    def __post_init__(self) -> None:
        chance = np.random.default_rng(SEED)
        # Left to itself it would draw from, and seed, the one generator that all share.
        options = dict(
            bounds=[0.0, 1.0],
            seed=np.nan,
            randn=lambda *size: chance.standard_normal(size),
            popsize=GENERATION,
            verbose=-9,
        )
        self._strategy = cma.CMAEvolutionStrategy(self.candidate.start(), SIGMA, options)

    def ask(self) -> list[np.ndarray]:
        """The next generation; the first has the candidate as it begins in it."""
        asked = self._strategy.ask()
        return [self.candidate.start(), *asked[1:]] if self.trials == 0 else asked

    def tell(self, asked: list[np.ndarray], scores: list[float]) -> None:
        """What a generation was worth; the last of a search may not be whole."""
        self.trials += len(asked)
        best = int(np.argmax(scores))
        if scores[best] > self.score:
            self.score, self.values = scores[best], self.candidate.values(asked[best])
        if len(asked) == GENERATION:
            self._strategy.tell(asked, [-each for each in scores])


def search(
    candidates: list[Candidate], workers: Workers, trials: int, done: Callable[[], Any]
) -> list[Search]:
    """Search all candidates with so many trials together: first all of them, then the better half."""
    searches = [Search(candidate) for candidate in candidates]
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
    for gone in workers.go(tasks):
        scores.append(score(gone.parts))
        done()
    for one, generation in zip(active, asked, strict=True):
        if generation:
            one.tell(generation, scores[: len(generation)])
            scores = scores[len(generation) :]
    return len(tasks)


def ranked(
    searches: list[Search], workers: Workers, speed_mm_s: float, done: Callable[[], Any]
) -> list[tuple[Search, Gone]]:
    """The best of each candidate gone once more, as fast as it will be; the best of these first."""
    tried = [one for one in searches if one.values]
    rows = []
    for one, gone in zip(
        tried, workers.go([(each.candidate, each.values, speed_mm_s) for each in tried]), strict=True
    ):
        rows.append((one, gone))
        done()
    return sorted(rows, key=lambda row: -score(row[1].parts))
