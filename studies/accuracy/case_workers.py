"""Evaluation of a bead experiment in a worker (``rehearsal.worker_processes``).

Each process keeps the experiments that it has built.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rehearsal.configuration import Setup
from rehearsal.worker_processes import built_once
from sim.sampling import RestBody
from studies.accuracy.bead_case import BeadCase
from studies.accuracy.bead_errors import bead_errors
from studies.accuracy.bead_experiment import BeadExperiment, rest_body

# Taichi frees fields only when it is started anew, and fails with hundreds of them.
MOST_BUILT = 4

_filled: dict[tuple[str, str, float], RestBody] = {}


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
    key = "shape matching", case.digest, setup.tissue.radius_mm

    def build() -> BeadExperiment:
        if key not in _filled:
            _filled[key] = rest_body(case, setup)
        return BeadExperiment(case, setup, _filled[key])

    experiment = built_once(key, build, MOST_BUILT)
    run = experiment.run(setup)
    errors = bead_errors(case, run.beads) if run.finite else np.full(case.measured.shape[:2], np.inf)
    size = experiment.model.counts()
    return Measured(errors, run.step_ms, size["particles"], size["clusters"])
