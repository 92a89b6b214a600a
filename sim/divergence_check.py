"""Divergence check: detects states that tissue cannot have, and restores the last good state.

It works for every tissue model: it tests small tetrahedra of neighbouring points, spread over the body.
"""

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.spatial import cKDTree

from sim.fields import field_of, fields_of, fill, zeros
from sim.kernels import kernel
from sim.solver import Solver, SolverState

MOST_TETRAHEDRA = 2000
NEIGHBOURS = 10
# An edge is torn at this multiple of its rest length, a tetrahedron flat at this fraction of its rest volume.
TORN, FLAT = 4.0, 0.02
# Tissue within this distance of a tool is not tested: it recovers when the tool moves away.
CRUSHED_MM = 10.0
# Largest fraction of tangled tetrahedra.
MOST_TANGLED = 0.005
# Most tangles resolve by themselves within this time and this number of steps.
PATIENCE_S, PATIENCE_STEPS = 2.0, 120
# Interval at which good states are stored.
KEEP_S, KEEP_STEPS = 1.0, 60
# A point this far from the body's rest centre has left the scene; beyond the second distance it counts as not
# finite.
FARTHEST_MM, INFINITE_MM = 500.0, 1e12

# All bits of a float32 but its sign, and those of INFINITE_MM: they are ordered as the numbers are, and what
# is no number is above.
MAGNITUDE, INFINITE_BITS = 0x7FFFFFFF, int(np.float32(INFINITE_MM).view(np.int32))


@dataclass(frozen=True)
class Health:
    """Result of one check: ``tangled`` is the fraction of tetrahedra that are torn, flat or inverted and
    not near the tool.
    """

    finite: bool
    farthest_mm: float
    tangled: float

    @property
    def is_lost(self) -> bool:
        """Whether the body cannot recover."""
        return not self.finite or self.farthest_mm > FARTHEST_MM

    @property
    def fault(self) -> str:
        """What is wrong with the tissue, in words; empty if nothing is."""
        if not self.finite:
            return "its positions were not finite numbers"
        if self.is_lost:
            return "it had left the scene"
        return "it was torn, flat or inside out" if self.tangled > MOST_TANGLED else ""


@dataclass(frozen=True)
class DivergenceState:
    """State of the check between steps: the last good state, the steps since then and since the tissue is
    tangled, whether that state has been restored since, and the time [s] since then.
    """

    good: SolverState
    steps_since_good: int = 0
    steps_tangled: int = 0
    is_restored: bool = False
    since_good_s: float = 0.0


class DivergenceCheck:
    """Checks a solver's body after each step; ``restorations`` counts how often it had to restore a state.

    ``initial`` is the state to restore if the last good one leads to a fault again.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver: Any = solver
        self.body: Any = solver.body
        self.tool: Any = solver.tool
        self.has_tool = solver.has_tool
        self.serial = solver.model.serial
        rest = self.body.rest_points
        corners = tetrahedra_among(rest)
        self.count, self.has_tetrahedra = len(corners), len(corners) > 0
        self.middle = ti.Vector(rest.mean(axis=0).tolist())
        self.farthest = zeros()
        # Numbers of points that are not finite, and of tangled tetrahedra.
        self.faults = zeros(2, within=1, kind=ti.i32)
        if self.has_tetrahedra:
            self.per_volume = field_of(np.ones(self.count))
            self.corner, self.longest = fields_of(corners, np.ones((self.count, 3)), within=1)
            self._fill(corners)
        self.restorations = 0
        self.set_initial_state()

    def _fill(self, corners: np.ndarray) -> None:
        """Test the tetrahedra with these corners (t, 4)."""
        rest = self.body.rest_points
        edges = rest[corners[:, 1:]] - rest[corners[:, :1]]
        longest = TORN * np.linalg.norm(edges, axis=2)
        fill((self.per_volume, 1.0 / np.linalg.det(edges)), (self.corner, corners), (self.longest, longest))

    def test_among(self, is_tissue: np.ndarray) -> None:
        """Test only tetrahedra of points that are tissue (n,), as many as before; more of them are tested
        twice where there are fewer.
        """
        among = np.flatnonzero(is_tissue)
        if self.has_tetrahedra:
            corners = among[tetrahedra_among(self.body.rest_points[among])]
            self._fill(np.resize(corners, (self.count, 4)))

    def set_initial_state(self) -> None:
        """Store the current state as the initial and the last good state."""
        self.initial = self.solver.snapshot()
        self.state = DivergenceState(self.initial)

    def store_if_healthy(self) -> None:
        """Store the current state as the last good one, if nothing is wrong with it."""
        health = self.health()
        if health.tangled == 0.0 and not health.is_lost:
            self.state = DivergenceState(self.solver.snapshot())

    def check(self, time_step_s: float) -> str:
        """Check the body after a step.

        If it diverged, restore a good state and return a message, else an empty text.
        """
        health = self.health()
        is_tangled = health.tangled > MOST_TANGLED
        state = replace(
            self.state,
            steps_since_good=self.state.steps_since_good + 1,
            steps_tangled=self.state.steps_tangled + 1 if is_tangled else 0,
            since_good_s=self.state.since_good_s + time_step_s,
        )
        patience = max(PATIENCE_STEPS, round(PATIENCE_S / time_step_s))
        if health.is_lost or state.steps_tangled > patience:
            return self._restore(health.fault, state.since_good_s)
        if health.tangled == 0.0 and state.steps_since_good >= max(KEEP_STEPS, round(KEEP_S / time_step_s)):
            state = DivergenceState(self.solver.snapshot())
        self.state = state
        return ""

    def _restore(self, fault: str, since_good_s: float) -> str:
        """Restore the last good state with zero velocity; if that was already restored, the initial state."""
        state, where = self.state.good, f"as it was {since_good_s:.1f} s before"
        if self.state.is_restored:
            state, where = self.initial, "as it was at the start"
        still = replace(state.body, velocity=np.zeros_like(state.body.velocity))
        self.solver.restore(SolverState(still, state.internal_state))
        self.state = DivergenceState(state, is_restored=True)
        self.restorations += 1
        return f"State restored, {where}: {fault}"

    def health(self) -> Health:
        """Result of checking the body now."""
        not_finite, tangled, farthest = self._examine()
        return Health(not_finite == 0, float(farthest), float(tangled) / max(self.count, 1))

    @kernel
    def _examine(self) -> tm.vec3:
        """Numbers of points that are not finite and of tangled tetrahedra, and the distance of the
        farthest point.
        """
        # Counts and maxima do not depend on the order, so these atomics are deterministic.
        self.faults[None] = ti.Vector([0, 0])
        self.farthest[None] = 0.0
        ti.loop_config(serialize=self.serial)
        for i in range(self.body.count):
            x = self.body.position[i]
            if is_finite(x):
                ti.atomic_max(self.farthest[None], (x - self.middle).norm())
            else:
                self.faults[None][0] += 1
        if ti.static(self.has_tetrahedra):
            ti.loop_config(serialize=self.serial)
            for t in range(self.count):
                if self.is_tangled(t):
                    self.faults[None][1] += 1
        counts = self.faults[None]
        return tm.vec3(counts.x, counts.y, self.farthest[None])

    @ti.func
    def is_tangled(self, t):
        """Whether tetrahedron t is torn, flat or inverted, and not near the tool."""
        corner, longest = self.corner[t], self.longest[t]
        origin = self.body.position[corner[0]]
        a = self.body.position[corner[1]] - origin
        b = self.body.position[corner[2]] - origin
        c = self.body.position[corner[3]] - origin
        tangled = a.dot(b.cross(c)) * self.per_volume[t] < FLAT
        tangled |= a.norm() > longest.x or b.norm() > longest.y or c.norm() > longest.z
        if ti.static(self.has_tool):
            if tangled:
                tangled = self.tool.is_beyond(origin, CRUSHED_MM)
        return tangled


@ti.func
def is_finite(x):
    """Whether a position has numbers below INFINITE_MM alone: by their bits, as comparisons with what is
    no number may be left out.
    """
    finite = True
    for k in ti.static(range(3)):
        finite &= (ti.bit_cast(x[k], ti.i32) & MAGNITUDE) < INFINITE_BITS
    return finite


def tetrahedra_among(points: np.ndarray) -> np.ndarray:
    """Corners (t, 4) of small, well-shaped tetrahedra of points (n, 3), spread evenly over their order."""
    if len(points) < 4:
        return np.zeros((0, 4), int)
    first = np.unique(np.linspace(0, len(points) - 1, MOST_TETRAHEDRA).astype(int))
    near = cKDTree(points).query(points[first], min(NEIGHBOURS, len(points)))[1][:, 1:]
    trios = np.array(list(combinations(range(near.shape[1]), 3)))
    edges = points[near] - points[first, None]
    units = edges / np.linalg.norm(edges, axis=2, keepdims=True)
    quality = np.abs(np.linalg.det(units[:, trios])) / np.linalg.norm(edges, axis=2)[:, trios].max(axis=2)
    best = trios[quality.argmax(axis=1)]
    flat = quality.max(axis=1) <= 1e-6
    return np.column_stack([first, np.take_along_axis(near, best, axis=1)])[~flat]
