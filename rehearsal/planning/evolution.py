"""One candidate's best numbers by CMA-ES (Hansen 2016, "The CMA evolution strategy: a tutorial"; the package cma)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from rehearsal.planning.score import score
from rehearsal.planning.score_terms import ScoreTerms
from rehearsal.planning.sweep_candidates import Candidate

SEED = 20161130
# The first steps are this share of the ranges: of forecasts, then of trials, which begin where those ended.
FAR, NEAR = 0.2, 0.06
# Forecasts of each candidate; trials, and forecasts, in a generation.
FORECASTS, GENERATION = 240, 8


@dataclass
class Search:
    """One candidate's search; the same trials give the same.

    ``best`` (n,) are the best shares so far of the candidate's ranges; none before the first trial.
    """

    candidate: Candidate
    start: np.ndarray
    sigma: float
    best: np.ndarray = field(default_factory=lambda: np.zeros(0))
    score: float = -np.inf
    trials: int = 0

    def __post_init__(self) -> None:
        # A window that makes no plan need not wait for it: two seconds, with all that it imports.
        import cma

        chance = np.random.default_rng(SEED)
        # Left to itself it would draw from, and seed, the one generator that all share.
        options = dict(
            bounds=[0.0, 1.0],
            seed=np.nan,
            randn=lambda *size: chance.standard_normal(size),
            popsize=GENERATION,
            verbose=-9,
        )
        self._about = partial(cma.CMAEvolutionStrategy, sigma0=self.sigma, inopts=options)
        self._strategy = self._about(self.start)

    @property
    def values(self) -> dict[str, float]:
        """The candidate's numbers of the best so far."""
        return self.candidate.values(self.best)

    def ask(self) -> list[np.ndarray]:
        """The next generation; the first has the start in it, and where the candidate itself begins."""
        asked = self._strategy.ask()
        return [self.start, self.candidate.start(), *asked[2:]] if self.trials == 0 else asked

    def tell(self, asked: list[np.ndarray], scores: list[float]) -> None:
        """What a generation was worth; the last of a search may not be whole.

        The search goes on about the candidate's own beginning where nothing in the first was better.
        """
        best, is_first = int(np.argmax(scores)), self.trials == 0
        self.trials += len(asked)
        if scores[best] > self.score:
            self.score, self.best = scores[best], asked[best]
        if is_first and best == 1:
            self._strategy = self._about(asked[1])
        elif len(asked) == GENERATION:
            self._strategy.tell(asked, [-each for each in scores])


def foreseen(candidate: Candidate, worth: Callable[[dict[str, float]], ScoreTerms]) -> np.ndarray:
    """Shares (n,) of a candidate's ranges that do best by a forecast."""
    found = Search(candidate, candidate.start(), FAR)
    while found.trials < FORECASTS:
        asked = found.ask()
        found.tell(asked, [score(worth(candidate.values(shares))) for shares in asked])
    return found.best
