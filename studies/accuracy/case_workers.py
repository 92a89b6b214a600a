"""Evaluation of a bead experiment in a worker (``rehearsal.worker_processes``).

Each process computes on one CPU thread and keeps the experiments that it has built.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

import sim.device
from rehearsal.configuration import Setup
from sim.sampling import RestBody
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_errors import bead_errors
from studies.accuracy.bead_experiment import BeadExperiment, rest_body

# Taichi frees fields only when it is started anew, and fails with hundreds of them.
MOST_BUILT = 4

_built: dict[tuple[str, float], BeadExperiment] = {}
_filled: dict[tuple[str, float], RestBody] = {}
# A Dask worker may run several threads; Taichi serves one.
_turn = threading.Lock()


@dataclass(frozen=True)
class Measured:
    """Result of an evaluation: bead errors (stages, n) [mm], times of the steps [ms], size of the model."""

    errors: np.ndarray
    step_ms: list[float]
    particles: int
    clusters: int


Evaluate = Callable[[Sequence[tuple[BeadCase, Setup]]], Iterator[Measured]]


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
