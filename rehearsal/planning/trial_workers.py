"""Trials in parallel processes; the results do not depend on how many.

Each process computes on one CPU thread and keeps the model that it has built.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future
from dataclasses import dataclass, replace
from itertools import islice
from typing import Self

import numpy as np
from joblib import cpu_count
from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import ShutdownExecutorError

import sim.device
from rehearsal.coordinates import probe_in_patient
from rehearsal.planning.candidate_search import surrogate_optimum
from rehearsal.planning.instrument_reach import InstrumentReach
from rehearsal.planning.plan_file import PlanError
from rehearsal.planning.rigid_surrogate import RigidSurrogate
from rehearsal.planning.sweep_candidates import SweepCandidate, candidates_of
from rehearsal.planning.sweep_path import SweepPath
from rehearsal.planning.sweep_score import ScoreTerms
from rehearsal.planning.sweep_trial import Trial
from rehearsal.rehearsal import Rehearsal
from rehearsal.worker_processes import end_with_parent
from scenes.anatomy import LoadedAnatomy, fingerprint
from scenes.scene import Scene, Trocar
from ultrasound.coverage import VOXEL_MM, Coverage
from ultrasound.probe import Probe
from ultrasound.target import Target


@dataclass(frozen=True)
class PlanningProblem:
    """The target of a patient that a plan is to cover. Raises PlanError for a tumour target without a tumour."""

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
    def without_images(self) -> "PlanningProblem":
        """The same without CT, labels and parts, which no trial needs."""
        return replace(self, anatomy=replace(self.anatomy, ct=None, labels=None, parts={}))


@dataclass(frozen=True)
class TrialResult:
    """The score terms of a path, and the poses (n, 4, 4) of its passes: probe in the patient, in PLUS's axes (LPS, mm)."""

    terms: ScoreTerms
    passes: list[np.ndarray]


@dataclass(frozen=True)
class SearchSpace:
    """The candidates for a problem, and the settings of the tissue model."""

    candidates: list[SweepCandidate]
    model: dict[str, float | int | str]


# A candidate, its parameters, and the speed on its passes [mm/s].
Task = tuple[SweepCandidate, dict[str, float], float]


class TrialWorkers:
    """Processes that try sweeps for one problem, as many as there are processors where ``jobs`` is None; a context manager.

    Even a single one is a separate process, because Taichi may be in use in this one. All methods may raise PlanError.
    """

    def __init__(self, problem: PlanningProblem, jobs: int | None = None) -> None:
        self.problem, self._jobs = problem.without_images, jobs or cpu_count()
        self._pool = ProcessPoolExecutor(self._jobs, initializer=end_with_parent, initargs=(os.getpid(),))
        settings = problem.scene, problem.probe, problem.target, problem.margin_mm, problem.trocar
        self._key = fingerprint(self.problem.anatomy) + repr(settings)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def search_space(self) -> SearchSpace:
        """The candidates, and what the tissue is computed with."""
        return next(self._map(_search_space, [()]))

    def surrogate_optima(self, candidates: Sequence[SweepCandidate]) -> Iterator[np.ndarray]:
        """The parameters (n,) of each, scaled to 0 to 1, with the best score on the rigid surrogate."""
        return self._map(_surrogate_optimum, [(each,) for each in candidates])

    def try_candidates(self, tasks: Sequence[Task]) -> Iterator[TrialResult]:
        """Results in the order of the tasks, each as soon as it is there."""
        return self._map(_try_candidate, tasks)

    def try_paths(
        self, makers: Sequence[Callable[[Trial], SweepPath]], speed_mm_s: float
    ) -> Iterator[TrialResult]:
        """The same for other paths, each made in its process."""
        return self._map(_try_path, [(maker, speed_mm_s) for maker in makers])

    def stop(self) -> None:
        """End the processes; a thread that waits for them gets a PlanError."""
        self._pool.shutdown(wait=False, kill_workers=True)

    def _map(self, function: Callable, tasks: Sequence[tuple]) -> Iterator:
        waiting: deque[Future] = deque()
        left = iter(tasks)
        try:
            while True:
                # With more tasks queued than its processes soon take, loky's own thread fails when it is stopped.
                for task in islice(left, 2 * self._jobs - len(waiting)):
                    waiting.append(self._pool.submit(function, self._key, self.problem, *task))
                if not waiting:
                    return
                yield waiting.popleft().result()
        except (BrokenExecutor, ShutdownExecutorError, CancelledError):
            raise PlanError(
                "a process of the search was ended, perhaps for lack of memory; close other programs, or give fewer --jobs"
            ) from None


_built: dict[str, Trial] = {}


def _trial(key: str, problem: PlanningProblem) -> Trial:
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
        centre = coverage.origin_mm + VOXEL_MM * np.argwhere(coverage.targets[problem.target]).mean(axis=0)
        reach = InstrumentReach(problem.trocar, rehearsal.manipulator, rehearsal.origin, centre)
        _built[key] = Trial(rehearsal, coverage, problem.target, reach)
    return _built[key]


def _search_space(key: str, problem: PlanningProblem) -> SearchSpace:
    trial = _trial(key, problem)
    rehearsal, step = trial.rehearsal, trial.rehearsal.settings
    solver = dict(time_step_s=step.time_step_s, substeps=step.substeps, iterations=step.iterations)
    model = rehearsal.scene.tissue.model_dump(mode="json") | solver | rehearsal.model.counts()
    return SearchSpace(candidates_of(rehearsal, trial.coverage, trial.target, trial.reach), model)


def _surrogate_optimum(key: str, problem: PlanningProblem, candidate: SweepCandidate) -> np.ndarray:
    trial = _trial(key, problem)
    trial.rehearsal.reset()
    surrogate = RigidSurrogate(trial.rehearsal, trial.coverage, trial.target, trial.reach)
    return surrogate_optimum(
        candidate, lambda values: surrogate.evaluate(candidate.path(surrogate.manipulator, values))
    )


def _try_candidate(
    key: str, problem: PlanningProblem, candidate: SweepCandidate, values: dict[str, float], speed_mm_s: float
) -> TrialResult:
    return _try_path(
        key, problem, lambda trial: candidate.path(trial.rehearsal.manipulator, values), speed_mm_s
    )


def _try_path(
    key: str, problem: PlanningProblem, make: Callable[[Trial], SweepPath], speed_mm_s: float
) -> TrialResult:
    trial = _trial(key, problem)
    path = make(trial)
    terms = trial.run(path, speed_mm_s)
    return TrialResult(
        terms, [np.stack([probe_in_patient(trial.rehearsal, pose) for pose in each]) for each in path.passes]
    )
