"""A time step: the paper's Algorithm 1. Line numbers in docstrings and comments are those of its listing."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
import taichi.math as tm
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked_dataclass

from sim import fields
from sim.body import BodyState
from sim.fields import array_of, fill, fill_evenly
from sim.kernels import function, kernel
from sim.self_contact import SelfContacts
from sim.shapes import MOST_SUBSTEPS, ConvexTool
from sim.tissue_model import TissueModel

# Keeps scaled masses far from the origin finite in float32.
MOST_EXPONENT = 30.0


@checked_dataclass(config=ConfigDict(validate_assignment=True, allow_inf_nan=False))
class StepSettings:
    """Settings of a step; the defaults are the paper's Table 1, except the stiffness, which it does not give.

    ``stiffness`` is alpha of Eq. 12, ``relaxation_factor`` is w of Eq. 7 (successive over-relaxation),
    ``gravity`` (3,) is in mm/s^2, ``damping`` [1/s] is the rate at which velocities decay. Raises ValueError
    for a value out of range.
    """

    stiffness: float = Field(default=0.95, ge=0, le=1)
    time_step_s: float = Field(default=1 / 60, ge=1e-6, le=10)
    substeps: int = Field(default=3, ge=1, le=MOST_SUBSTEPS)
    iterations: int = Field(default=9, ge=1, le=100_000)
    stabilisation_iterations: int = Field(default=1, ge=0, le=100_000)
    relaxation_factor: float = Field(default=1.0, ge=0, le=2)
    damping: float = Field(default=12.0, ge=0, le=1e6)
    gravity: tuple[float, float, float] = (0.0, 0.0, -9810.0)


@dataclass(frozen=True)
class SolverState:
    """All that steps change: the body, and what contacts and tissue carry from step to step, by name."""

    body: BodyState
    internal_state: dict[str, np.ndarray]


class Solver:
    """Steps one body with its tissue model and contacts with shapes, and optionally self-contact and a moving
    tool.

    For what is None no kernel is compiled and no memory taken.
    """

    def __init__(
        self,
        model: TissueModel,
        self_contacts: SelfContacts | None = None,
        tool: ConvexTool | None = None,
    ) -> None:
        self.body: Any = model.body
        self.model = model
        self.serial = model.serial
        self.contacts: Any = model.contacts
        self.self_contacts = self_contacts
        self.tool = tool
        self.has_tool = tool is not None
        self.has_contacts = model.contacts is not None
        self.has_self_contacts = self_contacts is not None
        self.internal_state: dict[str, fields.Field] = getattr(model, "internal_state", {})
        self.has_internal_state = bool(self.internal_state)

    def step(self, settings: StepSettings, tool_poses: np.ndarray | None = None) -> None:
        """Advance by one time step.

        ``tool_poses`` (substeps + 1, 4, 4), world from tool [mm], are the tool's poses at the start of the
        step and at the end of each substep; without them the tool does not move. Raises ValueError for poses
        that are not finite, before anything has moved.
        """
        dt = settings.time_step_s / settings.substeps
        if self.tool is not None:
            still = np.stack([self.tool.last_pose] * (settings.substeps + 1))
            self.tool.follow(still if tool_poses is None else tool_poses)
        # Gravity as three numbers: passing a vector to a kernel takes three times as long.
        start = dt, *settings.gravity, settings.damping, settings.stabilisation_iterations
        iterations = settings.iterations
        for substep in range(settings.substeps):
            self.start_substep(substep, *start)
            if self.serial:
                self.iterate(iterations, settings.stiffness, settings.relaxation_factor, dt)
            else:
                for iteration in range(iterations):
                    factor = relaxation_at(iteration, iterations, settings.relaxation_factor)
                    self.iterate(1, settings.stiffness, factor, dt)
            self.finish_substep(dt)
        # The same kernel as in ``restore``: another one may round differently.
        self.model.update_frames()

    def snapshot(self) -> SolverState:
        """A copy of the current state."""
        contacts = self.contacts.snapshot() if self.contacts else {}
        tissue = {name: array_of(field) for name, field in self.internal_state.items()}
        return SolverState(self.body.snapshot(), contacts | tissue)

    def restart(self) -> None:
        """The stress-free shape, without velocities, contacts and internal variables."""
        self.body.restore(self.body.rest_state())
        if self.contacts:
            self.contacts.reset()
        for field in self.internal_state.values():
            fill_evenly(field, 0.0)
        self.model.update_frames()

    def restore(self, state: SolverState) -> None:
        """Restore a state; the steps that follow give the same bits as they did from it before."""
        self.body.restore(state.body)
        if self.contacts:
            carried = state.internal_state.items()
            contacts = {name: values for name, values in carried if name not in self.internal_state}
            self.contacts.restore(contacts)
        fill(*((field, state.internal_state[name]) for name, field in self.internal_state.items()))
        self.model.update_frames()

    @kernel
    def start_substep(
        self,
        substep: int,
        dt: float,
        gravity_x: float,
        gravity_y: float,
        gravity_z: float,
        damping: float,
        stabilisation_iterations: int,
    ):
        """The start of a substep: on one core for bodies so small that starting threads takes longer than
        they save, as the kernels below.
        """
        gravity = tm.vec3(gravity_x, gravity_y, gravity_z)
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.start(substep, dt, gravity, damping, stabilisation_iterations)
        else:
            self.start(substep, dt, gravity, damping, stabilisation_iterations)

    @kernel
    def iterate(self, iterations: int, stiffness: float, relaxation_factor: float, dt: float):
        """All iterations of a substep on one core, or the next one on all cores: only outermost loops run
        in parallel.
        """
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for iteration in range(iterations):
                self.correct(stiffness, relaxation_at(iteration, iterations, relaxation_factor), dt)
        else:
            self.correct(stiffness, relaxation_factor, dt)

    @kernel
    def finish_substep(self, dt: float):
        """The end of a substep."""
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.finish(dt)
        else:
            self.finish(dt)

    @ti.func
    def start(self, substep, dt: float, gravity: tm.vec3, damping: float, stabilisation_iterations: int):
        """Lines 1-15: prediction, search for contacts, and stabilisation of contacts violated at the
        start.
        """
        if ti.static(self.has_tool):
            for _ in range(1):
                self.tool.start_substep(substep)
        self.predict(dt, gravity, damping)
        self.model.begin(dt)
        if ti.static(self.has_self_contacts):
            self.self_contacts.find()  # line 7
        if ti.static(self.has_contacts):
            self.contacts.find()  # line 8
            self.contacts.stabilise(stabilisation_iterations)
        self.model.gather()

    @ti.func
    def predict(self, dt: float, gravity: tm.vec3, damping: float):
        """Lines 1-5: predicted positions, and scaled masses if the body has them."""
        decay = ti.exp(-damping * dt)
        for i in range(self.body.count):
            # Damping does not apply to gravity, or a body at rest would weigh less.
            velocity = self.body.velocity[i] * decay + dt * gravity
            self.body.predicted[i] = self.body.position[i] + dt * velocity
            if ti.static(self.body.mass_scaled):  # line 4, with the height against gravity
                height = -gravity.dot(self.body.predicted[i]) / ti.max(gravity.norm(), 1e-12)
                exponent = tm.clamp(self.body.mass_scaling_per_mm * height, -MOST_EXPONENT, MOST_EXPONENT)
                self.body.mass_scale[i] = ti.exp(-exponent)

    @ti.func
    def correct(self, stiffness: float, relaxation_factor: float, dt: float):
        """Lines 17-21: one iteration over all groups of constraints."""
        self.model.project(stiffness, relaxation_factor, dt)
        if ti.static(self.has_self_contacts):
            self.model.scatter()
            self.self_contacts.project(relaxation_factor)
            self.model.gather()

    @ti.func
    def finish(self, dt: float):
        """Lines 23-26: velocities and positions from the predicted positions."""
        self.model.scatter()
        if ti.static(self.has_internal_state):
            self.model.finish(dt)  # type: ignore[attr-defined]
        if ti.static(self.has_contacts):
            self.contacts.finish()
        self.update_velocities(dt)

    @function
    def update_velocities(self, dt: float):
        """Lines 24 and 25."""
        for i in range(self.body.count):
            x = self.body.predicted[i]
            self.body.velocity[i] = (x - self.body.position[i]) / dt
            self.body.position[i] = x


@ti.pyfunc
def relaxation_at(iteration: int, iterations: int, relaxation_factor: float) -> float:
    """Relaxation factor of an iteration, 1 in the last: line 24 would turn its overshoot into velocity,
    which would grow.
    """
    return relaxation_factor if iteration < iterations - 1 else 1.0
