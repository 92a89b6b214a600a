"""A case put together on the device and pressed: the warm-up, then stage by stage, the beads read at each one's end."""

from dataclasses import dataclass, field

import numpy as np
import trimesh

from sim.body import Body, RestBody, fill_body
from sim.contact import REACH_RADII, ShapeContacts
from sim.shape_matching import ShapeMatching
from sim.shapes import ConvexTool, TriangleMesh
from sim.skinning import Skin
from sim.solver import Solver, StepSettings
from studies.case import Case
from studies.report import timed
from studies.setup import Setup
from ultrasound.probe import between

# The share of a stage's steps in which the probe moves; in the others the tissue comes to rest, as it did for the scan.
MOVING = 2 / 3
# How far back along the press the probe waits while the organ settles.
AWAY_MM = 60.0
# Where a case does not say: the paper's. It scales all masses alike.
DENSITY_KG_M3 = 1050.0


@dataclass
class Run:
    """One run: beads (stages, n, 3) [mm] at each stage's end, each stage step's time, whether all stayed finite."""

    beads: np.ndarray
    step_ms: list[float] = field(default_factory=list)
    finite: bool = True


class Experiment:
    """A case on the device, which can be run with several setups that share model and radius.

    Needs Taichi to be initialised. All positions on the device are relative to ``origin``, the middle of the organ.
    Raises SamplingError when the radius is too large for the organ.
    """

    def __init__(self, case: Case, setup: Setup, rest: RestBody | None = None) -> None:
        self.case = case
        self.origin = case.organ.bounds.mean(axis=0)
        self.rest = rest or rest_body(case, setup)
        self.body = Body(self.rest)
        self.model = ShapeMatching(self.body)
        support = _shifted(case.support, -self.origin)
        reach = REACH_RADII * setup.radius_mm
        tool = ConvexTool.cuboid(case.size_mm, case.edge_radius_mm)
        shapes = [TriangleMesh(support.vertices, support.faces, reach), tool]
        self.contacts = ShapeContacts(self.body, shapes, case.friction)
        self.solver = Solver(self.body, self.model, self.contacts, tool=tool)
        self.beads = Skin(self.model, case.beads - self.origin)

    def run(self, setup: Setup) -> Run:
        """Press the organ from its stress-free shape.

        It settles for the warm-up's 120 steps with the probe away, as at its stage-0 place the probe would be in the way
        of an organ that is not yet down. Then each stage takes 90 steps: in the first 60 the probe goes evenly to its
        pose of that stage (to that of stage 0 along the press), in the others it rests. The same setup
        gives the same beads, whatever ran before.
        """
        self._restore()
        step = self._step_settings(setup)
        pose = self._away()
        run = Run(np.zeros_like(self.case.measured))
        for _ in range(setup.warm_up_steps):
            self.solver.step(step, between(pose, pose, step.substeps))
        moving = max(1, round(MOVING * setup.stage_steps))
        for stage, goal in enumerate(self.case.poses):
            path = between(pose, self._relative(goal), moving)
            for n in range(setup.stage_steps):
                poses = between(path[min(n, moving)], path[min(n + 1, moving)], step.substeps)
                timed(lambda: self.solver.step(step, poses), run.step_ms)
            pose = path[-1]
            self.beads.update()
            run.beads[stage] = self.beads.vertices.to_numpy() + self.origin
            run.finite &= bool(np.isfinite(self.body.position.to_numpy()).all())
        run.finite &= bool(np.isfinite(run.beads).all())
        return run

    def size(self, setup: Setup) -> dict[str, float]:
        """How large the model is, under the names of a report: ``radius_mm`` or ``nodes``, and ``particles``."""
        return dict(radius_mm=setup.radius_mm, particles=self.body.count)

    def describe(self, setup: Setup) -> str:
        """Size and settings that the model does not share with others, for the terminal."""
        return f"{self.body.count} particles of {setup.radius_mm:g} mm, stiffness {setup.stiffness:g}"

    def _restore(self) -> None:
        self.body.restore(self.body.rest_state())
        self.contacts.forget()
        self.model.update_frames()

    def _step_settings(self, setup: Setup) -> StepSettings:
        x, y, z = self.case.gravity.tolist()
        return StepSettings(
            stiffness=setup.stiffness,
            relaxation_factor=setup.relaxation_factor,
            substeps=setup.substeps,
            iterations=setup.iterations,
            time_step_s=setup.time_step_s,
            gravity=(x, y, z),
        )

    def _relative(self, pose: np.ndarray) -> np.ndarray:
        moved = pose.copy()
        moved[:3, 3] -= self.origin
        return moved

    def _away(self) -> np.ndarray:
        pose = self._relative(self.case.poses[0])
        pose[:3, 3] -= AWAY_MM * self.case.press_direction
        return pose


def rest_body(case: Case, setup: Setup) -> RestBody:
    """The organ filled with particles, which takes seconds; Experiments of one case and radius can share it."""
    organ = _shifted(case.organ, -case.organ.bounds.mean(axis=0))
    return fill_body(organ, setup.radius_mm, (case.density_kg_m3 or DENSITY_KG_M3) / 1000)


def _shifted(mesh: trimesh.Trimesh, by: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices + by, mesh.faces, process=False)
