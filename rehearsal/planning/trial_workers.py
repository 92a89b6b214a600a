"""Trials in parallel processes; the results do not depend on how many.

Each process computes on one CPU thread and keeps the trial that it has built.
"""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future
from itertools import islice
from typing import Any, Self

from joblib import cpu_count
from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import ShutdownExecutorError

import sim.device
from rehearsal.planning.plan_file import PlanError
from rehearsal.planning.sweep_trial import PlanningProblem, Trial
from rehearsal.worker_processes import end_with_parent


class TrialWorkers:
    """Processes with a trial of one problem each, as many as there are processors where ``jobs`` is None; a context manager.

    Even a single one is a separate process, because Taichi may be in use in this one.
    """

    def __init__(self, problem: PlanningProblem, jobs: int | None = None) -> None:
        self.problem, self._jobs = problem, jobs or cpu_count()
        self._pool = ProcessPoolExecutor(self._jobs, initializer=end_with_parent, initargs=(os.getpid(),))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def map(self, function: Callable, tasks: Sequence[tuple]) -> Iterator[Any]:
        """The results of ``function(trial, *task)`` in the order of the tasks, each as soon as it is there. Raises PlanError."""
        waiting: deque[Future] = deque()
        left, problem = iter(tasks), self.problem.without_images
        try:
            while True:
                # With more tasks queued than its processes soon take, loky's own thread fails when it is stopped.
                for task in islice(left, 2 * self._jobs - len(waiting)):
                    waiting.append(self._pool.submit(_call, problem, function, *task))
                if not waiting:
                    return
                yield waiting.popleft().result()
        except (BrokenExecutor, ShutdownExecutorError, CancelledError):
            raise PlanError(
                "a process of the search was ended, perhaps for lack of memory; close other programs, or give fewer --jobs"
            ) from None

    def stop(self) -> None:
        """End the processes; a thread that waits for them gets a PlanError."""
        self._pool.shutdown(wait=False, kill_workers=True)


# The trial of this process, which has one problem only.
_built: list[Trial] = []


def _call(problem: PlanningProblem, function: Callable, *task: object) -> Any:
    if not _built:
        sim.device.start("cpu", cpu_max_num_threads=1)
        _built.append(Trial(problem))
    return function(_built[0], *task)
