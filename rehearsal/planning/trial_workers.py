"""Trials of one problem: in parallel on workers, or in this process; the results are the same."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol
from uuid import uuid4

from rehearsal.planning.sweep_trial import PlanningProblem, Trial
from rehearsal.worker_processes import Workers, built_once


class Trials(Protocol):
    """What tries sweeps for a problem."""

    problem: PlanningProblem

    def map(self, function: Callable, tasks: Sequence[tuple]) -> Iterator[Any]:
        """The results of ``function(trial, *task)`` in the order of the tasks, each as soon as it is
        there.
        """


class TrialWorkers:
    """Workers with a trial of one problem each."""

    def __init__(self, problem: PlanningProblem, workers: Workers) -> None:
        self.problem, self._workers = problem, workers
        self._key, self._sent = uuid4().hex, workers.share(problem.without_images)

    def map(self, function: Callable, tasks: Sequence[tuple]) -> Iterator[Any]:
        """As ``Trials.map``. Raises WorkerError."""
        return self._workers.map(_call, ((self._key, self._sent, function, *task) for task in tasks))


class TrialHere:
    """The one trial of this process."""

    def __init__(self, problem: PlanningProblem, trial: Trial) -> None:
        self.problem, self._trial = problem, trial

    def map(self, function: Callable, tasks: Sequence[tuple]) -> Iterator[Any]:
        """As ``Trials.map``."""
        return (function(self._trial, *task) for task in tasks)


def _call(key: str, problem: PlanningProblem, function: Callable, *task: object) -> Any:
    return function(built_once(key, lambda: Trial(problem)), *task)
