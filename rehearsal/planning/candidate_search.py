"""CMA-ES over the parameters of one candidate (Hansen 2016, "The CMA evolution strategy: a tutorial"; package cma)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from rehearsal.planning.sweep_candidates import SweepCandidate
from rehearsal.planning.sweep_score import ScoreTerms, score

SEED = 20161130
# Initial step size as a fraction of the ranges: on the rigid surrogate, then in trials, which start at its optimum.
SURROGATE_SIGMA, TRIAL_SIGMA = 0.2, 0.06
# Surrogate evaluations of each candidate; evaluations in a generation.
SURROGATE_EVALUATIONS, GENERATION = 240, 8


@dataclass
class CandidateSearch:
    """The search of one candidate's parameters; deterministic.

    ``best`` (n,) are the best parameters so far, scaled to 0 to 1; empty before the first trial.
    """

    candidate: SweepCandidate
    start: np.ndarray
    sigma: float
    best: np.ndarray = field(default_factory=lambda: np.zeros(0))
    score: float = -np.inf
    trials: int = 0

    def __post_init__(self) -> None:
        # Imported here: it takes two seconds, which a window without a plan need not wait for.
        import cma

        random = np.random.default_rng(SEED)
        # By default cma draws from NumPy's global generator, and seeds it.
        options = dict(
            bounds=[0.0, 1.0],
            seed=np.nan,
            randn=lambda *size: random.standard_normal(size),
            popsize=GENERATION,
            verbose=-9,
        )
        self._strategy_from = partial(cma.CMAEvolutionStrategy, sigma0=self.sigma, inopts=options)
        self._strategy = self._strategy_from(self.start)

    @property
    def values(self) -> dict[str, float]:
        """The best parameters so far, by name."""
        return self.candidate.values(self.best)

    def ask(self) -> list[np.ndarray]:
        """The next generation. The first contains ``start`` and the candidate's own default."""
        asked = self._strategy.ask()
        return [self.start, self.candidate.start(), *asked[2:]] if self.trials == 0 else asked

    def tell(self, asked: list[np.ndarray], scores: list[float]) -> None:
        """Take the scores of a generation; the last one may be incomplete.

        The search restarts at the candidate's default where that was the best of the first generation.
        """
        best, is_first = int(np.argmax(scores)), self.trials == 0
        self.trials += len(asked)
        if scores[best] > self.score:
            self.score, self.best = scores[best], asked[best]
        if is_first and best == 1:
            self._strategy = self._strategy_from(asked[1])
        elif len(asked) == GENERATION:
            self._strategy.tell(asked, [-each for each in scores])


def surrogate_optimum(
    candidate: SweepCandidate, evaluate: Callable[[dict[str, float]], ScoreTerms]
) -> np.ndarray:
    """The parameters (n,), scaled to 0 to 1, with the best score on the rigid surrogate."""
    search = CandidateSearch(candidate, candidate.start(), SURROGATE_SIGMA)
    while search.trials < SURROGATE_EVALUATIONS:
        asked = search.ask()
        search.tell(asked, [score(evaluate(candidate.values(scaled))) for scaled in asked])
    return search.best
