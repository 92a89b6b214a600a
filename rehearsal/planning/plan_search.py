"""The search for a plan: candidates started on the rigid surrogate, optimised in trials on the deforming organ, and ranked.

Each candidate's parameters are searched by CMA-ES (Hansen 2016, "The CMA evolution strategy: a tutorial"; package cma).
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np

from rehearsal.coordinates import probe_in_patient
from rehearsal.planning.plan_file import MOST_SWEEPS, Plan, PlanError, PlannedSweep
from rehearsal.planning.rigid_surrogate import RigidSurrogate
from rehearsal.planning.sweep_candidates import SweepCandidate, candidates_of
from rehearsal.planning.sweep_score import ScoreTerms, in_words, points, score, why_better
from rehearsal.planning.sweep_trial import Trial
from rehearsal.planning.trial_workers import Trials
from version import VERSION

SEED = 20161130
# Initial step size as a fraction of the ranges: on the rigid surrogate, then in trials, which start at its optimum.
SURROGATE_SIGMA, TRIAL_SIGMA = 0.2, 0.06
# Surrogate evaluations of each candidate, which take as long as so many trials; evaluations in a generation.
SURROGATE_EVALUATIONS, SURROGATE_TRIALS, GENERATION = 240, 2, 8
# Trials of the search are faster than the planned sweep.
TRIAL_MM_S = 60.0
DIGITS = 6
Progress = Callable[[int], Any]
# The score terms of a path, and the poses (n, 4, 4) of its passes: probe in the patient, in PLUS's axes (LPS, mm).
TriedPath = tuple[ScoreTerms, list[np.ndarray]]


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


# What the processes compute, each with its trial.


def search_space(trial: Trial) -> tuple[list[SweepCandidate], dict[str, float | int | str]]:
    """The candidates, and what the tissue is computed with."""
    rehearsal, step = trial.rehearsal, trial.rehearsal.settings
    solver = dict(time_step_s=step.time_step_s, substeps=step.substeps, iterations=step.iterations)
    model = rehearsal.scene.tissue.model_dump(mode="json") | solver | rehearsal.model.counts()
    return candidates_of(trial), model


def surrogate_optimum(trial: Trial, candidate: SweepCandidate) -> np.ndarray:
    """The parameters (n,), scaled to 0 to 1, with the best score on the rigid surrogate."""
    trial.rehearsal.reset()
    surrogate = RigidSurrogate(trial)
    search = CandidateSearch(candidate, candidate.start(), SURROGATE_SIGMA)
    while search.trials < SURROGATE_EVALUATIONS:
        asked = search.ask()
        paths = [candidate.path(surrogate.manipulator, candidate.values(scaled)) for scaled in asked]
        search.tell(asked, [score(surrogate.evaluate(path)) for path in paths])
    return search.best


def try_candidate(
    trial: Trial, candidate: SweepCandidate, values: dict[str, float], speed_mm_s: float
) -> TriedPath:
    """Try a candidate with its parameters, at a speed on its passes."""
    return try_path(trial, lambda of: candidate.path(of.rehearsal.manipulator, values), speed_mm_s)


def try_path(trial: Trial, make: Callable[[Trial], list[np.ndarray]], speed_mm_s: float) -> TriedPath:
    """Try a path that is made for the trial."""
    passes = make(trial)
    terms = trial.run(passes, speed_mm_s)
    return terms, [np.stack([probe_in_patient(trial.rehearsal, pose) for pose in each]) for each in passes]


# The search


def total_work(trials: int, speed_mm_s: float) -> int:
    """The work of ``make_plan`` at most, in trials."""
    return trials + MOST_SWEEPS * (SURROGATE_TRIALS + work_at(speed_mm_s))


def work_at(speed_mm_s: float) -> int:
    """The work of one sweep at a speed, in trials: half of a trial's time does not depend on the speed."""
    return max(1, round((1 + TRIAL_MM_S / speed_mm_s) / 2))


def make_plan(workers: Trials, speed_mm_s: float, trials: int, progress: Progress) -> Plan:
    """Search a plan for the workers' problem. Raises PlanError where no sweep is reachable.

    ``progress`` is called with 0 when the search begins, then with the work done, in trials; the sum is ``total_work``.
    """
    problem = workers.problem
    ((candidates, model),) = workers.map(search_space, [()])
    progress(0)
    searches = search(candidates, workers, trials, progress)
    rows = [row for row in ranked(searches, workers, speed_mm_s, progress) if row[2]]
    if not rows or rows[0][1].reachable < 1.0:
        raise PlanError(
            "no sweep was found that an instrument through the trocar can hold at all poses, and that starts outside the organ; move the "
            "trocar, widen its cone, or give the search more --trials"
        )
    sweeps = [
        PlannedSweep(
            name=one.candidate.name(len(passes)),
            score=round(score(terms), DIGITS),
            parts=_rounded(asdict(terms)),
            points=_rounded(points(terms)),
            values=_rounded(one.values),
            trials=one.trials,
            passes=[np.round(each, DIGITS).tolist() for each in passes],
        )
        for one, terms, passes in rows
    ]
    first, *others = [(sweep.name, terms) for sweep, (_, terms, _) in zip(sweeps, rows, strict=True)]
    why = [f"The first sweep is {first[0]}, with {score(first[1]):.1f} points: {in_words(first[1])}."]
    for name, terms in others:
        reason = why_better(first[1], terms)
        why.append(f"It comes before {name}, with {score(terms):.1f} points: {reason}.")
    return Plan(
        version=VERSION,
        anatomy=problem.fingerprint,
        target=problem.target,
        margin_mm=problem.margin_mm,
        speed_mm_s=speed_mm_s,
        probe=problem.probe.model_dump(by_alias=True, mode="json"),
        trocar=problem.trocar,
        model=model,
        seed=SEED,
        why=why,
        sweeps=sweeps,
    )


def search(
    candidates: list[SweepCandidate], workers: Trials, trials: int, progress: Progress
) -> list[CandidateSearch]:
    """Search all candidates with a total of trials: one generation of each, then the better half with the rest."""
    searches = []
    optima = workers.map(surrogate_optimum, [(each,) for each in candidates])
    for candidate, start in zip(candidates, optima, strict=True):
        searches.append(CandidateSearch(candidate, start, TRIAL_SIGMA))
        progress(SURROGATE_TRIALS)
    left = trials - _generation(searches, workers, trials, progress)
    better = sorted(searches, key=lambda one: -one.score)[: -(-len(searches) // 2)]
    while left > 0:
        left -= _generation(better, workers, left, progress)
    return searches


def _generation(active: list[CandidateSearch], workers: Trials, most: int, progress: Progress) -> int:
    """Run one generation of each search, with at most so many trials; return how many were run."""
    share = [most // len(active) + (number < most % len(active)) for number in range(len(active))]
    asked = [one.ask()[:count] for one, count in zip(active, share, strict=True)]
    tasks = [
        (one.candidate, one.candidate.values(scaled), TRIAL_MM_S)
        for one, generation in zip(active, asked, strict=True)
        for scaled in generation
    ]
    scores = []
    for terms, _ in workers.map(try_candidate, tasks):
        scores.append(score(terms))
        progress(1)
    for one, generation in zip(active, asked, strict=True):
        if generation:
            one.tell(generation, scores[: len(generation)])
            scores = scores[len(generation) :]
    return len(tasks)


def ranked(
    searches: list[CandidateSearch], workers: Trials, speed_mm_s: float, progress: Progress
) -> list[tuple[CandidateSearch, ScoreTerms, list[np.ndarray]]]:
    """The best of each candidate, tried once more at the planned speed; highest score first."""
    tried = [one for one in searches if one.trials]
    tasks = [(one.candidate, one.values, speed_mm_s) for one in tried]
    rows = []
    for one, (terms, passes) in zip(tried, workers.map(try_candidate, tasks), strict=True):
        rows.append((one, terms, passes))
        progress(work_at(speed_mm_s))
    return sorted(rows, key=lambda row: -score(row[1]))


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, DIGITS) for name, value in values.items()}
