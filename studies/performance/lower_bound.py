"""The step of shape matching beside references: its arithmetic as a plain loop in C, and pypbd."""

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from rehearsal.rehearsal import Rehearsal, script_length_s
from rehearsal.stopwatch import timed
from sim.body import ParticleBody
from sim.shape_matching import ShapeMatching
from sim.solver import Solver
from ultrasound.probe_manipulator import poses_between

SOURCE = Path(__file__).with_name("bound.c")
FLAGS = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-fPIC"]
# Linked apart and without -ffast-math, which would flush denormal numbers to zero in the whole process.
LINKED = ["-shared", "-fopenmp"]
STIFFNESS = 0.95
ROUNDS, STEPS_A_ROUND = 9, 5
# Idle threads sleep; otherwise they would slow down what is timed next.
IDLE = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"}


Runs = dict[str, Callable[[], None]]


class NoBound(RuntimeError):
    """A reference is not available on this machine; the message is one line."""


def memberships_of(model: ShapeMatching) -> tuple[csr_array, csr_array]:
    """The particles of each cluster, and the clusters of each particle."""
    particles = model.patches.clusters[model.patches.of_particles()]
    clusters = particles.T.tocsr()
    for rows in (clusters, particles):  # C reads 32 bits
        rows.indptr, rows.indices = rows.indptr.astype(np.int32), rows.indices.astype(np.int32)
    return clusters, particles


class Bound:
    """The cluster fits and averaged goals of a model alone, in C. Raises NoBound."""

    def __init__(self, model: ShapeMatching) -> None:
        compiler = shutil.which("gcc") or shutil.which("cc")
        if compiler is None:
            raise NoBound("no C compiler found: the bound in C is left out")
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        library, part = (str(Path(self._folder.name) / name) for name in ("bound.so", "bound.o"))
        for command in ([*FLAGS, "-c", str(SOURCE), "-o", part], [*LINKED, part, "-o", library]):
            if subprocess.run([compiler, *command], capture_output=True).returncode:
                raise NoBound("the C compiler cannot build the bound: it is left out")
        os.environ |= IDLE
        self._match = ctypes.CDLL(library).match
        clusters, particles = memberships_of(model)
        rest = model.body.rest_points.astype(np.float32)
        weight = (1 / np.diff(particles.indptr)).astype(np.float32)
        frames = np.tile(np.eye(3, dtype=np.float32).ravel(), (model.count, 1))
        self.x = rest.copy()
        self.x += 0.01 * np.sin(self.x[:, [1, 2, 0]])
        centres, translations = model.rest_centres.astype(np.float32), np.zeros((model.count, 3), np.float32)
        of_clusters = (clusters.shape[0], clusters.indptr, clusters.indices)
        of_particles = (len(rest), particles.indptr, particles.indices)
        arrays = (rest, centres, weight, frames, translations, self.x)
        self._arguments = [
            value if isinstance(value, int) else value.ctypes.data_as(ctypes.c_void_p)
            for value in (*of_clusters, *of_particles, *arrays)
        ]

    def run(self, iterations: int, threads: int) -> None:
        """Some iterations on some cores."""
        self._match(threads, iterations, ctypes.c_float(STIFFNESS), *self._arguments)

    def runs(self, iterations: int) -> Runs:
        """What is timed, by name."""
        return {
            "bound_1_core_ms": partial(self.run, iterations, 1),
            "bound_2_cores_ms": partial(self.run, iterations, 2),
        }


class Pypbd:
    """The same clusters in pypbd, the binding of PositionBasedDynamics, on one core. Raises NoBound."""

    def __init__(self, model: ShapeMatching) -> None:
        # Read when OpenMP is loaded.
        os.environ |= {"OMP_NUM_THREADS": "1", **IDLE}
        try:
            import pypbd
        except ImportError:
            raise NoBound(
                "pypbd is not installed: the comparison with it is left out; pip install pypbd==2.2.2"
            ) from None
        simulation = pypbd.Simulation.getCurrent()
        simulation.initDefault()
        self._model, self._stepper = simulation.getModel(), simulation.getTimeStep()
        self._key = pypbd.TimeStepController.MAX_ITERATIONS
        self._stepper.setValueUInt(pypbd.TimeStepController.NUM_SUB_STEPS, 1)
        pypbd.TimeManager.getCurrent().setTimeStepSize(1 / 180)
        clusters, particles = memberships_of(model)
        shared = np.diff(particles.indptr)
        data = self._model.getParticles()
        for i, point in enumerate(model.body.rest_points):
            data.addVertex(point)
            data.setMass(i, 1.0)
        for first, last in pairwise(clusters.indptr):
            members = clusters.indices[first:last]
            self._model.addShapeMatchingConstraint(
                len(members), members.tolist(), shared[members].tolist(), STIFFNESS
            )

    def run(self, iterations: int) -> None:
        """A step of some iterations, without contacts."""
        self._stepper.setValueUInt(self._key, iterations)
        self._stepper.step(self._model)

    def runs(self, iterations: int) -> Runs:
        """What is timed, by name."""
        return {"pypbd_1_core_ms": partial(self.run, iterations)}


def compare(rehearsal: Rehearsal) -> tuple[dict[str, Any], list[str]]:
    """Medians [ms] of the pressed body's step with contacts and of its references, run in turn.

    Also the references that are missing, and why.
    """
    solver, settings, model = rehearsal.organ.solver, rehearsal.organ.settings, rehearsal.organ.model
    assert isinstance(model, ShapeMatching) and isinstance(model.body, ParticleBody)
    iterations = settings.substeps * settings.iterations
    alone = Solver(ShapeMatching(model.body, model.patches))
    weightless = replace(settings, gravity=(0.0,) * 3)
    pose = rehearsal.scripted_pose(script_length_s(rehearsal.case))
    poses = poses_between(pose, pose, settings.substeps)
    runs: Runs = {
        "step_ms": lambda: solver.step(settings, poses),
        "without_contacts_ms": lambda: alone.step(weightless),
    }
    missing = []
    for reference in (Bound, Pypbd):
        try:
            runs |= reference(model).runs(iterations)
        except NoBound as reason:
            missing.append(str(reason))
    times: dict[str, list[float]] = {name: [] for name in runs}
    pressed = solver.snapshot()
    for _ in range(ROUNDS):
        for name, run in runs.items():
            solver.restore(pressed)
            for _ in range(STEPS_A_ROUND):
                timed(run, times[name])
    figures: dict[str, Any] = {name: round(float(np.median(ms)), 4) for name, ms in times.items()}
    step_ms, free_ms = figures["step_ms"], figures["without_contacts_ms"]
    bound_ms, pypbd_ms = figures.get("bound_2_cores_ms"), figures.get("pypbd_1_core_ms")
    work = model.counts()["memberships"] * iterations / 1e3
    figures |= dict(
        membership_iterations=round(1e3 * work),
        bound_ms=bound_ms,
        ratio_to_bound=_ratio(step_ms, bound_ms),
        million_a_second=round(work / free_ms, 2),
        pypbd_million_a_second=_ratio(work, pypbd_ms),
        times_pypbd=_ratio(pypbd_ms, free_ms),
    )
    return figures, missing


def _ratio(first: float | None, second: float | None) -> float | None:
    return round(first / second, 3) if first and second else None
