"""The search for a plan: passes varied on the rigid surrogate, then in trials on the deforming organ; the
best sets of them are ranked.

Both stages are an evolution strategy (Beyer & Schwefel 2002, "Evolution strategies: a comprehensive
introduction"): the best set of the passes tried so far is varied by random changes.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from rehearsal.planning.pass_kinds import PassKind, kinds_of
from rehearsal.planning.pass_selection import best_selection, score_of
from rehearsal.planning.plan_file import MOST_SWEEPS, Plan, PlanError, PlannedSweep
from rehearsal.planning.rigid_surrogate import RigidSurrogate
from rehearsal.planning.sweep_score import (
    ScoreTerms,
    TriedPass,
    face_centres,
    in_words,
    points,
    score,
    why_better,
)
from rehearsal.planning.sweep_trial import TRIAL_MM_S, Trial, Trials
from version import VERSION

SEED = 20161130
# On the rigid surrogate: passes at the beginning, rounds of variations, variations in each. They take as long
# as so many trials.
BEGINNING, ROUNDS, VARIATIONS, SURROGATE_TRIALS = 150, 6, 25, 4
# Standard deviation of a variation, as a fraction of a parameter's range: on the surrogate, and in trials.
SURROGATE_SIGMA, TRIAL_SIGMA = 0.08, 0.06
# Trials in a round.
ROUND_TRIALS = 8
# A sweep has about this path [mm], for the time that the last computation takes.
USUAL_PATH_MM = 250.0
DIGITS = 6
Progress = Callable[[int], Any]
# The score terms of a path, the poses (n, 4, 4) of its passes: probe in the patient, in PLUS's axes (LPS,
# mm), and those from each to the next.
TriedPath = tuple[ScoreTerms, list[np.ndarray], list[np.ndarray]]


class PassSearch:
    """The search for the best set of passes of one kind; deterministic.

    ``tried`` are the passes so far, ``best`` the best set of them.
    """

    def __init__(self, kind: PassKind, sigma: float) -> None:
        self.kind, self.sigma = kind, sigma
        self.tried: list[TriedPass] = []
        self.best: list[TriedPass] = []
        self._random = np.random.default_rng(SEED)

    @property
    def score(self) -> float:
        """The score of the best set, about; minus infinity before a trial."""
        return score_of(self.best)

    def first(self, count: int) -> list[np.ndarray]:
        """Parameters for the beginning: straight rows and random passes."""
        rows = self.kind.rows()
        return rows + self.kind.random(self._random, count - len(rows))

    def variations(self, count: int) -> list[np.ndarray]:
        """Parameters of the best set's passes with random changes: of each pass a large one, then a small
        one.
        """
        variations = []
        for number in range(count if self.best else 0):
            times, which = divmod(number, len(self.best))
            parameters = self.best[which].parameters
            change = self.sigma / (1 + times % 2) * self._random.standard_normal(parameters.shape)
            variations.append(np.clip(parameters + change, 0.0, 1.0))
        return variations

    def add(self, passes: Sequence[TriedPass | None]) -> None:
        """Add tried passes; None is one that the instrument cannot hold."""
        self.tried += [tried for tried in passes if tried is not None]
        self.best = best_selection(self.tried, self.kind.most_passes)


# What the processes compute, each with its trial.


def search_space(trial: Trial) -> tuple[list[PassKind], dict[str, float | int | str]]:
    """The kinds of pass, and what the tissue is computed with."""
    scene, step = trial.case.scene, trial.rehearsal.organ.settings
    solver = dict(time_step_s=step.time_step_s, substeps=step.substeps, iterations=step.iterations)
    model = scene.tissue.model_dump(mode="json") | solver | trial.rehearsal.organ.model.counts()
    return kinds_of(trial), model


def surrogate_search(trial: Trial, kind: PassKind) -> list[TriedPass]:
    """The best set of passes of a kind on the rigid surrogate."""
    surrogate, search = RigidSurrogate(trial), PassSearch(kind, SURROGATE_SIGMA)
    search.add([surrogate.try_pass(kind, parameters) for parameters in search.first(BEGINNING)])
    for _ in range(ROUNDS):
        search.add([surrogate.try_pass(kind, parameters) for parameters in search.variations(VARIATIONS)])
    return search.best


def try_pass(trial: Trial, kind: PassKind, parameters: np.ndarray) -> TriedPass | None:
    """Try one pass; None where the instrument cannot hold it."""
    poses = kind.poses(trial.manipulator, kind.values(parameters))
    return None if poses is None or not trial.held([poses]).all() else trial.try_pass(parameters, poses)


def try_sweep(trial: Trial, kind: PassKind, parameters: list[np.ndarray], speed_mm_s: float) -> TriedPath:
    """Try passes of a kind, one after the other, at a speed."""
    return try_path(trial, lambda of: _in_order(of, kind, parameters), speed_mm_s)


def try_path(trial: Trial, make: Callable[[Trial], list[np.ndarray]], speed_mm_s: float) -> TriedPath:
    """Try a path that is made for the trial."""
    passes = make(trial)
    terms = trial.run(passes, speed_mm_s)
    return terms, _placed(trial, passes), _placed(trial, trial.transfers(passes))


def _placed(trial: Trial, ways: list[np.ndarray]) -> list[np.ndarray]:
    """Poses as those of the probe in the patient."""
    return [np.stack([trial.case.probe_in_patient(pose) for pose in poses]) for poses in ways]


def _in_order(trial: Trial, kind: PassKind, parameters: list[np.ndarray]) -> list[np.ndarray]:
    """The passes, each the one that begins nearest to the end of the one before."""
    manipulator = trial.manipulator
    passes = [kind.poses(manipulator, kind.values(values)) for values in parameters]
    left = [poses for poses in passes if poses is not None]
    ordered = [left.pop(0)]
    while left:
        end = face_centres(manipulator, ordered[-1][-1:])[0]
        begins = np.stack([face_centres(manipulator, poses[:1])[0] for poses in left])
        ordered.append(left.pop(int(np.linalg.norm(begins - end, axis=1).argmin())))
    return ordered


# The search


def total_work(trials: int, speed_mm_s: float) -> int:
    """The work of ``make_plan`` at most, in trials."""
    return trials + 3 * SURROGATE_TRIALS + MOST_SWEEPS * work_at(speed_mm_s)


def work_at(speed_mm_s: float) -> int:
    """The work of one sweep at a speed, in trials of a pass."""
    return max(1, round(USUAL_PATH_MM / 50.0 * (1 + TRIAL_MM_S / speed_mm_s) / 2))


def make_plan(workers: Trials, speed_mm_s: float, trials: int, progress: Progress) -> Plan:
    """Search a plan for the workers' problem. Raises PlanError where no sweep is reachable.

    ``progress`` is called with 0 when the search begins, then with the work done, in trials; the sum is at
    most ``total_work``.
    """
    problem = workers.problem
    ((kinds, model),) = workers.map(search_space, [()])
    progress(0)
    searches = search(kinds, workers, trials, progress)
    if not searches:
        raise PlanError(
            "no sweep was found that an instrument through the trocar can hold at all poses, and that starts "
            "outside the organ; move the "
            "trocar, widen its cone, or give the search more --trials"
        )
    rows = ranked(searches, workers, speed_mm_s, progress)
    sweeps = [
        PlannedSweep(
            name=one.kind.name(len(passes)),
            score=round(score(terms), DIGITS),
            parts=_rounded(asdict(terms)),
            points=_rounded(points(terms)),
            trials=len(one.tried),
            passes=[np.round(poses, DIGITS).tolist() for poses in passes],
            transfers=[np.round(poses, DIGITS).tolist() for poses in transfers],
        )
        for one, terms, passes, transfers in rows
    ]
    first, *others = [(sweep.name, terms) for sweep, (_, terms, *_) in zip(sweeps, rows, strict=True)]
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


def search(kinds: list[PassKind], workers: Trials, trials: int, progress: Progress) -> list[PassSearch]:
    """The kinds with the best sets on the surrogate, and their searches in so many trials; the better one
    gets what is left after the first round.
    """
    rough = []
    for kind, best in zip(kinds, workers.map(surrogate_search, [(kind,) for kind in kinds]), strict=True):
        progress(SURROGATE_TRIALS)
        if best:
            rough.append((kind, best))
    rough = sorted(rough, key=lambda each: -score_of(each[1]))[:MOST_SWEEPS]
    searches = [PassSearch(kind, TRIAL_SIGMA) for kind, _ in rough]
    first = [[tried.parameters for tried in best] for _, best in rough]
    trials -= _try(searches, first, workers, trials, progress)
    searches = sorted((one for one in searches if one.best), key=lambda one: -one.score)
    while searches and trials > 0:
        better = searches[0]
        trials -= _try([better], [better.variations(ROUND_TRIALS)], workers, trials, progress)
    return searches


def _try(
    searches: list[PassSearch],
    parameters: list[list[np.ndarray]],
    workers: Trials,
    most: int,
    progress: Progress,
) -> int:
    """Try passes for each search, at most so many in all; return how many were tried."""
    owners = [one for one, passes in zip(searches, parameters, strict=True) for _ in passes][:most]
    tasks = zip([one.kind for one in owners], itertools.chain(*parameters), strict=False)
    tried = []
    for one_pass in workers.map(try_pass, list(tasks)):
        tried.append(one_pass)
        progress(1)
    for one in searches:
        one.add([one_pass for one_pass, owner in zip(tried, owners, strict=True) if owner is one])
    return len(tried)


def ranked(
    searches: list[PassSearch], workers: Trials, speed_mm_s: float, progress: Progress
) -> list[tuple[PassSearch, ScoreTerms, list[np.ndarray], list[np.ndarray]]]:
    """The best set of each search as a sweep at the planned speed; highest score first."""
    tasks = [(one.kind, [tried.parameters for tried in one.best], speed_mm_s) for one in searches]
    rows = []
    for one, tried in zip(searches, workers.map(try_sweep, tasks), strict=True):
        rows.append((one, *tried))
        progress(work_at(speed_mm_s))
    return sorted(rows, key=lambda row: -score(row[1]))


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, DIGITS) for name, value in values.items()}
