"""One candidate's best numbers by CMA-ES (Hansen 2016, "The CMA evolution strategy: a tutorial"; the package cma)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from studies.plan.candidate import Candidate
from studies.plan.parts import Parts
from studies.plan.score import score

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
        self._strategy = cma.CMAEvolutionStrategy(self.start, self.sigma, options)

    @property
    def values(self) -> dict[str, float]:
        """The candidate's numbers of the best so far."""
        return self.candidate.values(self.best)

    def ask(self) -> list[np.ndarray]:
        """The next generation; the first has the start in it."""
        asked = self._strategy.ask()
        return [self.start, *asked[1:]] if self.trials == 0 else asked

    def tell(self, asked: list[np.ndarray], scores: list[float]) -> None:
        """What a generation was worth; the last of a search may not be whole."""
        self.trials += len(asked)
        best = int(np.argmax(scores))
        if scores[best] > self.score:
            self.score, self.best = scores[best], asked[best]
        if len(asked) == GENERATION:
            self._strategy.tell(asked, [-each for each in scores])


def foreseen(candidate: Candidate, worth: Callable[[dict[str, float]], Parts]) -> np.ndarray:
    """Shares (n,) of a candidate's ranges that do best by a forecast."""
    found = Search(candidate, candidate.start(), FAR)
    while found.trials < FORECASTS:
        asked = found.ask()
        found.tell(asked, [score(worth(candidate.values(shares))) for shares in asked])
    return found.best
