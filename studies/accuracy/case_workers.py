"""Evaluations of cases in parallel processes, local or on a Dask cluster; the results do not depend on their number.

Each process computes on one CPU thread and keeps the experiments that it has built.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from joblib import Parallel, delayed, parallel_config

import sim.device
from errors import UserError
from rehearsal.configuration import Setup
from rehearsal.worker_processes import processes
from sim.sampling import RestBody
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_errors import bead_errors
from studies.accuracy.bead_experiment import BeadExperiment, rest_body

# Taichi frees fields only when it is started anew, and fails with hundreds of them.
MOST_BUILT = 4
CONNECT_S = 10

_built: dict[tuple[str, float], BeadExperiment] = {}
_filled: dict[tuple[str, float], RestBody] = {}
# A Dask worker may run several threads; Taichi serves one.
_turn = threading.Lock()


class WorkerError(UserError):
    """Workers that are not available; the message is one line."""


@dataclass(frozen=True)
class Measured:
    """Result of an evaluation: bead errors (stages, n) [mm], times of the steps [ms], size of the model."""

    errors: np.ndarray
    step_ms: list[float]
    particles: int
    clusters: int


Map = Callable[[Sequence[tuple[BeadCase, Setup]]], Iterator[Measured]]


def evaluate(case: BeadCase, setup: Setup) -> Measured:
    """Run a case in this process; errors are infinite where the result is not finite."""
    key = (case.digest, setup.tissue.radius_mm)
    with _turn:
        if key not in _built:
            _build(key, case, setup)
        experiment = _built[key]
        run = experiment.run(setup)
    errors = bead_errors(case, run.beads) if run.finite else np.full(case.measured.shape[:2], np.inf)
    size = experiment.model.counts()
    return Measured(errors, run.step_ms, size["particles"], size["clusters"])


def _build(key: tuple[str, float], case: BeadCase, setup: Setup) -> None:
    if len(_built) in (0, MOST_BUILT):
        _built.clear()
        sim.device.start("cpu", cpu_max_num_threads=1)
    if key not in _filled:
        _filled[key] = rest_body(case, setup)
    _built[key] = BeadExperiment(case, setup, _filled[key])


@contextmanager
def local_workers(jobs: int | None = None) -> Iterator[Map]:
    """``jobs`` processes on this machine, or one a processor."""
    with processes(jobs):
        yield _map


@contextmanager
def dask_workers(address: str) -> Iterator[Map]:
    """The workers of a running Dask cluster, with this project in their PYTHONPATH. Raises WorkerError."""
    try:
        from distributed import Client
    except ImportError:
        raise WorkerError(
            "--dask needs the packages dask and distributed; pip install dask distributed"
        ) from None
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkerError(
            f"--dask {address}: no scheduler answers there ({error}); start one, or correct it"
        ) from None
    with client:
        try:
            found = client.run(_ready)
        except Exception as error:  # any exception of a worker
            raise WorkerError(
                f"--dask {address}: a worker is not ready ({error}); start workers with this project's requirements "
                f"installed and its folder in PYTHONPATH"
            ) from None
        if not found:
            raise WorkerError(
                f"--dask {address}: the cluster has no workers; start some with: dask worker {address}"
            )
        with parallel_config(backend="dask", client=client, wait_for_workers_timeout=CONNECT_S):
            yield _map


def _ready() -> bool:
    """Importable by a worker that has the project's modules."""
    return True


def _map(pairs: Sequence[tuple[BeadCase, Setup]]) -> Iterator[Measured]:
    """Evaluations in the order of the pairs, as they are done."""
    for result in Parallel(batch_size=1, return_as="generator")(delayed(_attempt)(*pair) for pair in pairs):
        if isinstance(result, Exception):
            raise result
        yield result


def _attempt(case: BeadCase, setup: Setup) -> Measured | Exception:
    # joblib would wait forever for a task that raises on Dask.
    try:
        return evaluate(case, setup)
    except Exception as error:
        return error
