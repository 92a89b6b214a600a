"""A step in pieces, each a kernel of its own, so that each can be timed (the paper's Fig. 8)."""

from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm

from errors import UserError
from rehearsal.stopwatch import timed
from sim.kernels import kernel
from sim.shape_matching import ShapeMatching
from sim.solver import Solver, StepSettings, relaxation_at

# Before the iterations of a substep, in an iteration (of shape matching or not), after them; "frames" is once
# a step.
BEFORE = ("tool", "predict", "begin", "find contacts", "leave contacts", "gather")
IN_ITERATION = {
    True: ("fit clusters", "average goals", "move to goals", "contacts"),
    False: ("tissue and contacts",),
}
AFTER = ("scatter", "keep out", "velocities")
CONTACTS = ("find contacts", "leave contacts", "contacts", "keep out")


class Phases:
    """A solver whose steps are taken piece by piece, with the same settings each.

    ``ms``: time of each piece in the last step [ms], including that of ``calls`` calls from Python.
    """

    def __init__(self, solver: Solver, settings: StepSettings) -> None:
        if solver.has_self_contacts:
            raise UserError(
                "the pieces of a step are not measured with contacts of particles: leave out "
                "contact.particles"
            )
        self.settings = settings
        self.dt = settings.time_step_s / settings.substeps
        self.solver: Any = solver
        self.model: Any = solver.model
        self.serial = solver.model.serial
        self.in_iteration = IN_ITERATION[isinstance(solver.model, ShapeMatching)]
        self.ms: dict[str, float] = {}
        self.calls: dict[str, int] = {}

    def names(self) -> tuple[str, ...]:
        """All pieces, in their order."""
        return (*BEFORE, *self.in_iteration, *AFTER, "frames")

    def step(self, tool_poses: np.ndarray) -> None:
        """One time step, the same as ``Solver.step``."""
        settings = self.settings
        self.ms, self.calls = dict.fromkeys(self.names(), 0.0), dict.fromkeys(self.names(), 0)
        if self.solver.tool is not None:
            self.solver.tool.follow(tool_poses)
        for substep in range(settings.substeps):
            for name in BEFORE:
                self._timed(name, substep, 1.0)
            for iteration in range(settings.iterations):
                factor = relaxation_at(iteration, settings.iterations, settings.relaxation_factor)
                for name in self.in_iteration:
                    self._timed(name, substep, factor)
            for name in AFTER:
                self._timed(name, substep, 1.0)
        self._timed("frames")

    def _timed(self, name: str, *values) -> None:
        taken: list[float] = []
        timed(lambda: self._piece(name, *values) if values else self.model.update_frames(), taken)
        self.ms[name] += taken[0]
        self.calls[name] += 1

    @kernel
    def _piece(self, name: ti.template(), substep: int, factor: float):
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _once in range(1):
                self._work(name, substep, factor)
        else:
            self._work(name, substep, factor)

    @ti.func
    def _work(self, name: ti.template(), substep, factor):
        if ti.static(name == "tool" and self.solver.has_tool):
            for _ in range(1):
                self.solver.tool.start_substep(substep)
        if ti.static(name == "predict"):
            self.solver.predict(self.dt, tm.vec3(*self.settings.gravity), self.settings.damping)
        if ti.static(name == "begin"):
            self.model.begin(self.dt)
        if ti.static(name == "find contacts" and self.solver.has_contacts):
            self.solver.contacts.find()
        if ti.static(name == "leave contacts" and self.solver.has_contacts):
            self.solver.contacts.stabilise(self.settings.stabilisation_iterations)
        if ti.static(name == "gather"):
            self.model.gather()
        if ti.static(name == "fit clusters"):
            self.model.fit(False)
        if ti.static(name == "average goals"):
            self.model.average()
        if ti.static(name == "move to goals"):
            self.model.move_to_goals(self.settings.stiffness * factor)
        if ti.static(name == "contacts" and self.solver.has_contacts):
            self.model.push_out(factor)
        if ti.static(name == "tissue and contacts"):
            self.model.project(self.settings.stiffness, factor, self.dt)
        if ti.static(name == "scatter"):
            self.model.scatter()
        if ti.static(name == "keep out" and self.solver.has_contacts):
            self.solver.contacts.finish()
        if ti.static(name == "velocities"):
            self.solver.update_velocities(self.dt)


def without_calls(ms: dict[str, float], calls: dict[str, int], whole_ms: float) -> dict[str, float]:
    """Times of pieces [ms] that sum to ``whole_ms``, that of a step in one kernel.

    The difference is the time of the calls, the same for each call.
    """
    call_ms = max(sum(ms.values()) - whole_ms, 0.0) / sum(calls.values())
    own = {name: max(taken - call_ms * calls[name], 0.0) for name, taken in ms.items()}
    return {name: taken * whole_ms / sum(own.values()) for name, taken in own.items()}
