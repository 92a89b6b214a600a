"""What shape matching must be measured against: its arithmetic as a plain loop in C, and another program's."""

import ctypes
import os
import shutil
import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path
from time import perf_counter

import numpy as np

from sim.sampling import Clusters
from sim.shape_matching import ShapeMatching

SOURCE = Path(__file__).with_name("bound.c")
FLAGS = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-fPIC"]
# Apart, and without fast arithmetic: a library linked with it has the whole process lose its smallest numbers.
LINKED = ["-shared", "-fopenmp"]
STIFFNESS = 0.95
# Threads without work sleep, or they would slow down what is timed next.
IDLE = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"}


class NoBound(RuntimeError):
    """What is compared with is not on this machine; the message is one line."""


def memberships_of(model: ShapeMatching) -> tuple[Clusters, Clusters]:
    """A model's clusters by their particles, and its particles by their clusters."""
    patches = model.patches
    rows = [patches.clusters.members[a:b] for a, b in pairwise(patches.clusters.offsets)]
    of_particle = [rows[p] for p in patches.of_particles()]
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in of_particle])]).astype(np.int32)
    particles = Clusters(offsets, np.concatenate(of_particle).astype(np.int32))
    return particles.transposed(model.count), particles


class Bound:
    """A model's cluster fits and averaged goals, and nothing else, in C. Raises NoBound."""

    def __init__(self, model: ShapeMatching) -> None:
        compiler = shutil.which("gcc") or shutil.which("cc")
        if compiler is None:
            raise NoBound("no C compiler here: the bound in C is left out")
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        library, part = (str(Path(self._folder.name) / name) for name in ("bound.so", "bound.o"))
        for command in ([*FLAGS, "-c", str(SOURCE), "-o", part], [*LINKED, part, "-o", library]):
            if subprocess.run([compiler, *command], capture_output=True).returncode:
                raise NoBound("the C compiler here cannot make the bound: it is left out")
        os.environ |= IDLE
        self._match = ctypes.CDLL(library).match
        clusters, particles = memberships_of(model)
        rest = model.body.rest_points.astype(np.float32)
        weight = (1 / np.diff(particles.offsets)).astype(np.float32)
        frames = np.tile(np.eye(3, dtype=np.float32).ravel(), (model.count, 1))
        self.x = rest.copy()
        arrays: list[int | np.ndarray] = [
            rest,
            model.rest_centres.astype(np.float32),
            weight,
            frames,
            np.zeros((model.count, 3), np.float32),
        ]
        rows: list[int | np.ndarray] = [
            len(clusters),
            clusters.offsets,
            clusters.members,
            len(rest),
            particles.offsets,
            particles.members,
        ]
        self._arguments: list[int | np.ndarray] = [*rows, *arrays, self.x]
        self._match.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_float, *map(_kind, self._arguments)]
        self.x += 0.01 * np.sin(self.x[:, [1, 2, 0]])

    def run(self, iterations: int, threads: int) -> float:
        """So many iterations on so many cores; the time that they took [ms]."""
        given = [_passed(v) for v in self._arguments]
        started = perf_counter()
        self._match(threads, iterations, STIFFNESS, *given)
        return 1e3 * (perf_counter() - started)


def _kind(value: int | np.ndarray) -> type:
    return ctypes.c_int if isinstance(value, int) else ctypes.c_void_p


def _passed(value: int | np.ndarray) -> int:
    return value if isinstance(value, int) else value.ctypes.data


class Pypbd:
    """The same clusters in pypbd, the binding of PositionBasedDynamics, on one core. Raises NoBound."""

    def __init__(self, model: ShapeMatching) -> None:
        # Its OpenMP asks for this when it is loaded.
        os.environ |= {"OMP_NUM_THREADS": "1", **IDLE}
        try:
            import pypbd
        except ImportError:
            raise NoBound(
                "pypbd is not here: the comparison with it is left out; pip install pypbd==2.2.2"
            ) from None
        simulation = pypbd.Simulation.getCurrent()
        simulation.initDefault()
        self._model, self._stepper = simulation.getModel(), simulation.getTimeStep()
        self._key = pypbd.TimeStepController.MAX_ITERATIONS
        self._stepper.setValueUInt(pypbd.TimeStepController.NUM_SUB_STEPS, 1)
        pypbd.TimeManager.getCurrent().setTimeStepSize(1 / 180)
        clusters, particles = memberships_of(model)
        shared = np.diff(particles.offsets)
        data = self._model.getParticles()
        for i, point in enumerate(model.body.rest_points):
            data.addVertex(point)
            data.setMass(i, 1.0)
        for first, last in pairwise(clusters.offsets):
            members = clusters.members[first:last]
            self._model.addShapeMatchingConstraint(
                len(members), members.tolist(), shared[members].tolist(), STIFFNESS
            )

    def run(self, iterations: int) -> float:
        """A step of so many iterations, without contacts; the time that it took [ms]."""
        self._stepper.setValueUInt(self._key, iterations)
        started = perf_counter()
        self._stepper.step(self._model)
        return 1e3 * (perf_counter() - started)
