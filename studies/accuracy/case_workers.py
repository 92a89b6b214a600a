"""Evaluations of cases in parallel processes, here or on a Dask cluster; the figures do not depend on how many.

A process computes on one CPU thread, so that several do not fight for the same ones, and keeps what it has built.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from joblib import Parallel, delayed, parallel_config

import sim.device
from rehearsal.configuration import Setup
from rehearsal.worker_processes import processes
from sim.sampling import RestBody
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_errors import bead_errors
from studies.accuracy.bead_experiment import BeadExperiment, rest_body

# Taichi frees fields only when it starts anew, and does not bear hundreds of them.
MOST_BUILT = 4
CONNECT_S = 10

_built: dict[tuple[str, float], BeadExperiment] = {}
_filled: dict[tuple[str, float], RestBody] = {}
# A Dask worker may run several threads; Taichi serves one.
_turn = threading.Lock()


class WorkerError(RuntimeError):
    """Workers that cannot be had; the message is one line."""


@dataclass(frozen=True)
class Measured:
    """What an evaluation of a case came to: bead errors (stages, n) [mm], times of the steps [ms], the model's size."""

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
    """Processes on this machine, as many as it has processors where ``jobs`` is None."""
    with processes(jobs):
        yield _map


@contextmanager
def dask_workers(address: str) -> Iterator[Map]:
    """The workers of a running Dask cluster, which have this project in their PYTHONPATH. Raises WorkerError."""
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
        except Exception as error:  # what fails on a worker comes back as anything
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
    """Found by a worker which has the project's modules."""
    return True


def _map(pairs: Sequence[tuple[BeadCase, Setup]]) -> Iterator[Measured]:
    """Evaluations in the order of the pairs, as they are done."""
    for result in Parallel(batch_size=1, return_as="generator")(delayed(_attempt)(*pair) for pair in pairs):
        if isinstance(result, Exception):
            raise result
        yield result


def _attempt(case: BeadCase, setup: Setup) -> Measured | Exception:
    # joblib waits for ever for a task that raises on Dask.
    try:
        return evaluate(case, setup)
    except Exception as error:
        return error
