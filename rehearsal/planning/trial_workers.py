"""Trials of ways in parallel processes; the figures do not depend on how many.

A process computes on one CPU thread, so that several do not fight for the same ones, and keeps the model that it has built.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from joblib import cpu_count
from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import ShutdownExecutorError

import sim.device
from rehearsal.coordinates import probe_in_patient
from rehearsal.planning.evolution import foreseen
from rehearsal.planning.instrument_reach import Reach
from rehearsal.planning.plan_file import PlanError
from rehearsal.planning.rigid_surrogate import RigidSurrogate
from rehearsal.planning.score_terms import ScoreTerms
from rehearsal.planning.sweep_candidates import Candidate, candidates_of
from rehearsal.planning.sweep_path import SweepPath
from rehearsal.planning.trial import Trial
from rehearsal.rehearsal import Rehearsal
from rehearsal.worker_processes import end_with
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import Scene
from scenes.trocar import Trocar
from ultrasound.coverage import VOXEL_MM, Coverage
from ultrasound.probe import Probe
from ultrasound.target import Target


@dataclass(frozen=True)
class Problem:
    """What a plan is to solve: see a target of a patient. Raises PlanError for a tumour where there is none."""

    scene: Scene
    anatomy: LoadedAnatomy
    probe: Probe
    target: Target
    margin_mm: float
    trocar: Trocar

    def __post_init__(self) -> None:
        if self.target != "organ" and self.anatomy.tumour is None:
            raise PlanError(
                f"--target {self.target}: this scene has no tumour; expected organ, or another scene"
            )

    @property
    def bare(self) -> "Problem":
        """Without the pictures, which no trial asks for."""
        return replace(self, anatomy=replace(self.anatomy, ct=None, labels=None, parts={}))


@dataclass(frozen=True)
class Outcome:
    """What a way was worth, and its passes (n, 4, 4): probe in the patient, in PLUS's axes (LPS, mm)."""

    parts: ScoreTerms
    passes: list[np.ndarray]


@dataclass(frozen=True)
class SearchSpace:
    """The candidates for a problem, and what its tissue is computed with."""

    candidates: list[Candidate]
    model: dict[str, float | int | str]


# A candidate, its numbers, and the speed on its passes [mm/s].
Task = tuple[Candidate, dict[str, float], float]


class Workers:
    """Processes that try ways for one problem. All that they do may raise PlanError."""

    def __init__(self, problem: Problem, jobs: int) -> None:
        self.problem, self._jobs = problem.bare, jobs
        self._pool = ProcessPoolExecutor(jobs, initializer=end_with, initargs=(os.getpid(),))
        made_of = problem.scene, problem.probe, problem.target, problem.margin_mm, problem.trocar
        self._key = fingerprint(self.problem.anatomy) + repr(made_of)

    def search_space(self) -> SearchSpace:
        """What there is to search. Raises PlanError."""
        return next(self._all(_search_space, [()]))

    def foresee(self, candidates: Sequence[Candidate]) -> Iterator[np.ndarray]:
        """Where the search of each is to begin, shares (n,) of its ranges."""
        return self._all(_foreseen, [(each,) for each in candidates])

    def go(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """In the order of the tasks, as they are done."""
        return self._all(_go, tasks)

    def go_ways(self, ways: Sequence[Callable[[Trial], SweepPath]], speed_mm_s: float) -> Iterator[Outcome]:
        """The same of ways that are not candidates': each is made in its process."""
        return self._all(_go_way, [(way, speed_mm_s) for way in ways])

    def stop(self) -> None:
        """End the processes; whoever waits for them gets a PlanError."""
        self._pool.shutdown(wait=False, kill_workers=True)

    def _all(self, function: Callable, tasks: Sequence[tuple]) -> Iterator:
        waiting: deque[Future] = deque()
        left = iter(tasks)
        try:
            while True:
                # With more than its processes soon take, loky's own thread falls over where it is stopped.
                for task in islice(left, 2 * self._jobs - len(waiting)):
                    waiting.append(self._pool.submit(function, self._key, self.problem, *task))
                if not waiting:
                    return
                yield waiting.popleft().result()
        except (BrokenExecutor, ShutdownExecutorError, CancelledError):
            raise PlanError(
                "a process of the search was ended, perhaps for want of memory; close other programs, or give fewer --jobs"
            ) from None


@contextmanager
def workers(problem: Problem, jobs: int | None = None) -> Iterator[Workers]:
    """Processes on this machine, as many as it has processors where ``jobs`` is None.

    One is a process of its own too: this one may have a Taichi that is in use.
    """
    crew = Workers(problem, jobs or cpu_count())
    try:
        yield crew
    finally:
        crew.stop()


_built: dict[str, Trial] = {}


def _trial(key: str, problem: Problem, speed_mm_s: float) -> Trial:
    """The trial of a problem, built once in a process. Raises PlanError."""
    if key not in _built:
        _built.clear()
        sim.device.start("cpu", cpu_max_num_threads=1)
        rehearsal = Rehearsal(problem.scene, problem.anatomy, problem.probe)
        coverage = Coverage(rehearsal.organ, rehearsal.tumour, problem.margin_mm)
        if not coverage.targets[problem.target].any():
            raise PlanError(
                f"--target {problem.target}: it is smaller than a voxel of {VOXEL_MM:g} mm; expected a larger one"
            )
        middle = coverage.origin_mm + VOXEL_MM * np.argwhere(coverage.targets[problem.target]).mean(axis=0)
        reach = Reach(problem.trocar, rehearsal.manipulator, rehearsal.origin, middle)
        _built[key] = Trial(rehearsal, coverage, problem.target, reach, speed_mm_s)
    _built[key].speed_mm_s = speed_mm_s
    return _built[key]


def _search_space(key: str, problem: Problem) -> SearchSpace:
    trial = _trial(key, problem, 1.0)
    rehearsal, step = trial.rehearsal, trial.rehearsal.settings
    passes = dict(time_step_s=step.time_step_s, substeps=step.substeps, iterations=step.iterations)
    model = rehearsal.scene.tissue.model_dump(mode="json") | passes | rehearsal.model.counts()
    return SearchSpace(candidates_of(rehearsal, trial.coverage, trial.target, trial.reach), model)


def _foreseen(key: str, problem: Problem, candidate: Candidate) -> np.ndarray:
    trial = _trial(key, problem, 1.0)
    trial.rehearsal.reset()
    forecast = RigidSurrogate(trial.rehearsal, trial.coverage, trial.target, trial.reach)
    return foreseen(candidate, lambda values: forecast.parts(candidate.way(forecast.manipulator, values)))


def _go(
    key: str, problem: Problem, candidate: Candidate, values: dict[str, float], speed_mm_s: float
) -> Outcome:
    return _go_way(key, problem, lambda trial: candidate.way(trial.rehearsal.manipulator, values), speed_mm_s)


def _go_way(key: str, problem: Problem, make: Callable[[Trial], SweepPath], speed_mm_s: float) -> Outcome:
    trial = _trial(key, problem, speed_mm_s)
    way = make(trial)
    parts = trial.run(way)
    return Outcome(
        parts, [np.stack([probe_in_patient(trial.rehearsal, pose) for pose in each]) for each in way.passes]
    )
