"""Watches a body for states that no tissue has, and puts back the last good one: no rehearsal ends by an explosion.

What is watched does not depend on the tissue model: small tetrahedra of neighbouring points, spread over the body.
"""

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm
from scipy.spatial import cKDTree

from sim.fields import field_of, fields_of
from sim.solver import Solver, SolverState

MOST_TETRAHEDRA = 2000
NEIGHBOURS = 10
# An edge is torn when it is so many times as long as at rest, a tetrahedron flat at this share of its volume.
TORN, FLAT = 4.0, 0.02
# What a tool crushes within this distance of it comes back when it goes.
CRUSHED_MM = 10.0
# More than this share of the tetrahedra inside out or torn elsewhere is no tissue.
MOST_SHARE = 0.005
# Tissue finds its way back from most tangles by itself; it is given this time, and so many steps.
PATIENCE_S, PATIENCE_STEPS = 2.0, 120
# How often a good state is kept.
KEEP_S, KEEP_STEPS = 1.0, 60
# A point so far from where the body was at first has left the scene, and one so far is nowhere.
FARTHEST_MM, NO_PLACE_MM = 500.0, 1e12


@dataclass(frozen=True)
class Health:
    """What one look at a body found: ``tangled`` is the share of tetrahedra, away from the tool, that are torn, flat or
    inside out.
    """

    finite: bool
    farthest_mm: float
    tangled: float

    @property
    def is_lost(self) -> bool:
        """Whether there is nothing to wait for."""
        return not self.finite or self.farthest_mm > FARTHEST_MM

    @property
    def fault(self) -> str:
        """What is wrong with the tissue, in words; empty where it is well."""
        if not self.finite:
            return "its positions were no numbers any more"
        if self.is_lost:
            return "it had left the scene"
        return "it was torn, flat or inside out" if self.tangled > MOST_SHARE else ""


@dataclass(frozen=True)
class DivergenceState:
    """What a guard remembers between steps: the last good state, how long ago it was, how long the tissue has been tangled,
    and whether that state has been put back since.
    """

    good: SolverState
    steps_since_good: int = 0
    steps_tangled: int = 0
    is_restored: bool = False


@ti.data_oriented
class DivergenceCheck:
    """Looks at a solver's body after each step; ``fallbacks`` counts how often it had to put it back.

    ``home`` is the state to go back to where the last good one leads to the same fault again.
    """

    def __init__(self, solver: Solver) -> None:
        self.solver: Any = solver
        self.body: Any = solver.body
        self.tool: Any = solver.tool
        self.has_tool = solver.has_tool
        self.serial = solver.model.serial
        rest = self.body.rest_points
        corners = tetrahedra_among(rest)
        self.count = len(corners)
        self.has_tetrahedra = self.count > 0
        self.middle = ti.Vector(rest.mean(axis=0).tolist())
        self.reach = ti.field(ti.f32, ())
        self.broken = ti.Vector.field(2, ti.i32, ())
        if self.has_tetrahedra:
            edges = rest[corners[:, 1:]] - rest[corners[:, :1]]
            self.per_volume = field_of(1.0 / np.linalg.det(edges))
            self.corner, self.longest = fields_of(corners, TORN * np.linalg.norm(edges, axis=2), within=1)
        self.restorations = 0
        self.set_initial_state()

    def set_initial_state(self) -> None:
        """Take the body's state for the one to come home to."""
        self.initial = self.solver.snapshot()
        self.state = DivergenceState(self.initial)

    def store_if_healthy(self) -> None:
        """Take the body's state now for the last good one, where it is well."""
        health = self.health()
        if health.tangled == 0.0 and not health.is_lost:
            self.state = DivergenceState(self.solver.snapshot())

    def check(self, time_step_s: float) -> str:
        """Look at the body after a step; where it is no tissue any more put it back and say so, else an empty text."""
        health = self.health()
        is_tangled = health.tangled > MOST_SHARE
        watch = replace(
            self.state,
            steps_since_good=self.state.steps_since_good + 1,
            steps_tangled=self.state.steps_tangled + 1 if is_tangled else 0,
        )
        patience = max(PATIENCE_STEPS, round(PATIENCE_S / time_step_s))
        if health.is_lost or watch.steps_tangled > patience:
            return self._put_back(health.fault, time_step_s)
        if health.tangled == 0.0 and watch.steps_since_good >= max(KEEP_STEPS, round(KEEP_S / time_step_s)):
            watch = DivergenceState(self.solver.snapshot())
        self.state = watch
        return ""

    def _put_back(self, fault: str, time_step_s: float) -> str:
        """The last good state, at rest, so that what led here does not go on; where it led here before, home."""
        state, where = self.state.good, f"as it was {self.state.steps_since_good * time_step_s:.1f} s before"
        if self.state.is_restored:
            state, where = self.initial, "as it was at the start"
        still = replace(state.body, velocity=np.zeros_like(state.body.velocity))
        self.solver.restore(SolverState(still, state.contacts))
        self.state = DivergenceState(state, is_restored=True)
        self.restorations += 1
        return f"Tissue put back, {where}: {fault}"

    def health(self) -> Health:
        """How the body is now."""
        lost, broken, farthest = self._look()
        return Health(lost == 0, float(farthest), float(broken) / max(self.count, 1))

    @ti.kernel
    def _look(self) -> tm.vec3:
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.examine()
        else:
            self.examine()
        found = self.broken[None]
        return tm.vec3(found.x, found.y, self.reach[None])

    @ti.func
    def examine(self):
        """Points that are no numbers, tetrahedra that are no tissue, and how far the farthest point is."""
        for _ in range(1):
            self.broken[None] = ti.Vector([0, 0])
            self.reach[None] = 0.0
        # Counts and maxima do not depend on the order, so these atomics keep runs alike.
        for i in range(self.body.count):
            away = (self.body.position[i] - self.middle).norm()
            if away < NO_PLACE_MM:
                ti.atomic_max(self.reach[None], away)
            else:
                self.broken[None][0] += 1
        if ti.static(self.has_tetrahedra):
            for t in range(self.count):
                if self.is_broken(t):
                    self.broken[None][1] += 1

    @ti.func
    def is_broken(self, t):
        """Whether tetrahedron t is torn, flat or inside out, and not by the tool."""
        corner, longest = self.corner[t], self.longest[t]
        origin = self.body.position[corner[0]]
        a = self.body.position[corner[1]] - origin
        b = self.body.position[corner[2]] - origin
        c = self.body.position[corner[3]] - origin
        broken = a.dot(b.cross(c)) * self.per_volume[t] < FLAT
        broken |= a.norm() > longest.x or b.norm() > longest.y or c.norm() > longest.z
        if ti.static(self.has_tool):
            if broken:
                broken = self.tool.is_beyond(origin, CRUSHED_MM)
        return broken


def tetrahedra_among(points: np.ndarray) -> np.ndarray:
    """Corners (t, 4) of small, well-shaped tetrahedra of points (n, 3), spread evenly over their order; none of too few."""
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
