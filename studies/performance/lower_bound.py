"""References for the speed of shape matching: its arithmetic as a plain loop in C, and pypbd."""

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
# Linked apart and without -ffast-math, which would flush denormal numbers to zero in the whole process.
LINKED = ["-shared", "-fopenmp"]
STIFFNESS = 0.95
# Idle threads sleep; otherwise they would slow down what is timed next.
IDLE = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"}


class NoBound(RuntimeError):
    """A reference is not available on this machine; the message is one line."""


def memberships_of(model: ShapeMatching) -> tuple[Clusters, Clusters]:
    """The particles of each cluster, and the clusters of each particle."""
    patches = model.patches
    rows = [patches.clusters.members[a:b] for a, b in pairwise(patches.clusters.offsets)]
    of_particle = [rows[p] for p in patches.of_particles()]
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in of_particle])]).astype(np.int32)
    particles = Clusters(offsets, np.concatenate(of_particle).astype(np.int32))
    return particles.transposed(model.count), particles


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
        weight = (1 / np.diff(particles.offsets)).astype(np.float32)
        frames = np.tile(np.eye(3, dtype=np.float32).ravel(), (model.count, 1))
        self.x = rest.copy()
        self.x += 0.01 * np.sin(self.x[:, [1, 2, 0]])
        centres, translations = model.rest_centres.astype(np.float32), np.zeros((model.count, 3), np.float32)
        of_clusters = (len(clusters), clusters.offsets, clusters.members)
        of_particles = (len(rest), particles.offsets, particles.members)
        arrays = (rest, centres, weight, frames, translations, self.x)
        self._arguments = [
            value if isinstance(value, int) else value.ctypes.data_as(ctypes.c_void_p)
            for value in (*of_clusters, *of_particles, *arrays)
        ]

    def run(self, iterations: int, threads: int) -> float:
        """Time [ms] of some iterations on some cores."""
        started = perf_counter()
        self._match(threads, iterations, ctypes.c_float(STIFFNESS), *self._arguments)
        return 1e3 * (perf_counter() - started)


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
        """Time [ms] of a step of some iterations, without contacts."""
        self._stepper.setValueUInt(self._key, iterations)
        started = perf_counter()
        self._stepper.step(self._model)
        return 1e3 * (perf_counter() - started)
