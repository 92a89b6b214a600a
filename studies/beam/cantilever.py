"""A clamped beam in the lattice tissue model: its rest position and its oscillation."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sim.body import Body
from sim.fields import array_of
from sim.lattice import fill_block
from sim.material import Material
from sim.neo_hookean import NeoHookean
from sim.shapes import MOST_SUBSTEPS
from sim.solver import Solver, StepSettings
from studies.beam.motion_capture import BeamError

GRAVITY_MM_S2 = 9810.0
# Cells that a pressure wave crosses in a time step. With more, some ten iterations do not balance it and the
# energy grows. At Poisson's ratio 0.499 on 10 mm cells such a step is 0.05 ms, and rounding in float32 lowers
# the frequency by 0.3% (0.8% with half that step).
CELLS_A_STEP = 1.0
ITERATIONS = 20
# At rest: iterations of one step without inertia, doubled until the tip moves less than REST_TOLERANCE_MM.
REST_ITERATIONS = 4000
REST_RELAXATION = 1.9
REST_TOLERANCE_MM = 0.005
MOST_REST_ITERATIONS = 256_000
# The beam may differ from a whole number of cells by this.
WHOLE_MM = 0.01
# With a higher Poisson's ratio the search starts from the rest position at this one, with HARD_ITERATIONS:
# the tip moves slowly at first.
EASY_POISSON = 0.49
HARD_ITERATIONS = 16_000


@dataclass(frozen=True)
class BeamMaterial:
    """Young's modulus [kPa], Poisson's ratio, density [g/cm^3]."""

    young_kpa: float
    poisson: float
    density_g_cm3: float

    def pressure_wave_mm_s(self) -> float:
        """Speed of a pressure wave: the root of (lambda + 2 mu) over the density."""
        e, nu = 1e3 * self.young_kpa, self.poisson
        return float(np.sqrt(e * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / (1e-3 * self.density_g_cm3)))


class Cantilever:
    """A beam of size_mm (height, width, length), clamped at length 0; gravity is against the first axis.

    load_g hangs along the upper edge of the free end, or across it at hung_mm above the lower. Markers (n, 3)
    [mm] outside the beam stand on its nearest point and turn with its end. Raises BeamError when the cells do
    not fill it.
    """

    def __init__(
        self,
        size_mm: np.ndarray,
        material: BeamMaterial,
        cell_mm: float,
        load_g: float = 0.0,
        markers: np.ndarray | None = None,
        hung_mm: float | None = None,
    ) -> None:
        self.material = material
        self.size_mm = size = np.asarray(size_mm, float)
        markers = size * [0.5, 0.5, 1.0] if markers is None else np.asarray(markers, float)
        self.markers = np.atleast_2d(markers)
        counts = np.round(size / cell_mm).astype(int)
        if np.abs(counts * cell_mm - size).max() > WHOLE_MM:
            raise BeamError(
                f"a beam of {size[0]:g} x {size[1]:g} x {size[2]:g} mm is no whole number of {cell_mm:g} mm "
                "cells"
            )
        lattice = fill_block(tuple(counts), cell_mm)
        self.cell_mm = cell_mm
        self.feet = np.clip(self.markers, 0.0, size)
        self.frame, self.weight = lattice.interpolation.attach(self.feet)
        self.end = lattice.nodes[:, 2] > size[2] - 1.01 * cell_mm
        along = np.linspace(0, size[1], 31)
        height = size[0] if hung_mm is None else hung_mm
        line = np.column_stack([np.full(31, height), along, np.full(31, size[2])])
        node, share = lattice.interpolation.attach(line)
        load = np.bincount(node.ravel(), load_g / len(line) * share.ravel(), len(lattice.nodes))
        fixed = lattice.nodes[:, 2] < 1e-6 * size[2]
        self.body = Body(lattice.nodes)
        # 1 + nu is the exact hourglass stiffness of bending, of which a beam a few elements thick has much
        # inside them.
        tissue = Material(material.young_kpa, material.poisson, material.density_g_cm3)
        self.model = NeoHookean(
            self.body,
            lattice,
            None,
            tissue,
            fixed=fixed,
            load_g=load,
            hourglass_stiffness=1 + material.poisson,
        )
        self.solver = Solver(self.model)

    def displacement(self) -> np.ndarray:
        """Displacements of the markers (n, 3) [mm]. Raises BeamError where the computation failed."""
        moved = array_of(self.body.position).astype(float) - self.body.rest_points
        if not np.isfinite(moved).all():
            raise BeamError("the computed beam diverges; choose a lower --poisson or a higher --young-kpa")
        feet = np.einsum("nk,nkd->nd", self.weight, moved[self.frame])
        rest = self.body.rest_points[self.end]
        now = rest + moved[self.end]
        rotation = Rotation.align_vectors(now - now.mean(axis=0), rest - rest.mean(axis=0))[0]
        arm = self.markers - self.feet
        return feet + rotation.apply(arm) - arm

    def settings(self, **changes: Any) -> StepSettings:
        """Settings with gravity and no damping, and the given changes."""
        gravity = (-GRAVITY_MM_S2, 0.0, 0.0)
        return StepSettings(stabilisation_iterations=0, damping=0.0, gravity=gravity, **changes)

    def rest(self) -> tuple[np.ndarray, float]:
        """Marker displacements (n, 3) [mm] at rest, from the straight beam, and their change [mm] in the
        last half of the iterations.
        """
        self.body.restore(self.body.rest_state())
        if self.material.poisson > EASY_POISSON:
            self.model.set_material(self.material.young_kpa, EASY_POISSON)
            self._settle(REST_ITERATIONS)
            self.model.set_material(self.material.young_kpa, self.material.poisson)
            return self._settle(HARD_ITERATIONS)
        return self._settle(REST_ITERATIONS)

    def _settle(self, iterations: int) -> tuple[np.ndarray, float]:
        """Over-relaxed steps of 1 s, of negligible inertia, each with as many iterations as all before it."""
        total, left = 0, np.inf
        before = self.displacement()
        while left > REST_TOLERANCE_MM and total < MOST_REST_ITERATIONS:
            step = self.settings(
                time_step_s=1.0, substeps=1, iterations=iterations, relaxation_factor=REST_RELAXATION
            )
            self.solver.step(step)
            now = self.displacement()
            left = float(np.abs(now - before).max())
            before, total, iterations = now, total + iterations, total + iterations
        return before, left

    def substeps(self, frame_s: float) -> int:
        """Time steps in a frame, so that a pressure wave crosses CELLS_A_STEP cells in one."""
        return int(np.ceil(frame_s * self.material.pressure_wave_mm_s() / (CELLS_A_STEP * self.cell_mm)))

    def swing(
        self, frames: int, frame_s: float, substeps: int | None = None, iterations: int | None = None
    ) -> np.ndarray:
        """Marker displacements (frames + 1, n, 3) [mm] from a release from straight on."""
        self.body.restore(self.body.rest_state())
        substeps = substeps or self.substeps(frame_s)
        steps = -(-substeps // MOST_SUBSTEPS)
        step = self.settings(
            time_step_s=frame_s / steps,
            substeps=-(-substeps // steps),
            iterations=iterations or ITERATIONS,
            relaxation_factor=1.0,
        )
        traces = [self.displacement()]
        for _ in range(frames):
            for _ in range(steps):
                self.solver.step(step)
            traces.append(self.displacement())
        return np.array(traces)
