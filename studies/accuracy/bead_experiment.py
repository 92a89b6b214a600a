"""A case put together on the device and pressed: the warm-up, then stage by stage, the beads read at each one's end."""

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh

from rehearsal.build_solver import build_solver, static_shape, step_settings
from rehearsal.configuration import Setup, SetupError
from rehearsal.stopwatch import timed
from scenes.closed_surfaces import moved_by
from scenes.scene import Contact
from scenes.tissue import TissueSection
from sim.fields import array_of
from sim.sampling import RestBody
from sim.shape_matching import fill_organ
from sim.shapes import ConvexTool
from sim.skinning import Skin
from sim.solver import StepSettings
from studies.accuracy.bead_case import BeadCase
from ultrasound.probe_manipulator import poses_between

# The share of a stage's steps in which the probe moves; in the others the tissue comes to rest, as it did for the scan.
MOVING = 2 / 3
# How far back along the press the probe waits while the organ settles.
AWAY_MM = 60.0
# Where a case does not say: the paper's. It scales all masses alike.
DENSITY_KG_M3 = 1050.0


@dataclass
class BeadRun:
    """One run: beads (stages, n, 3) [mm] at each stage's end, and at the moment when the probe arrives; each stage step's
    time, whether all stayed finite.
    """

    beads: np.ndarray
    step_ms: list[float] = field(default_factory=list)
    finite: bool = True
    arriving: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))


class BeadExperiment:
    """A case on the device, which can be run with several setups that share model, size and material.

    Needs Taichi to be initialised. All positions on the device are relative to ``origin``, the middle of the organ.
    Raises SamplingError and SetupError.
    """

    def __init__(self, case: BeadCase, setup: Setup, rest: RestBody | None = None) -> None:
        self.case = case
        self.origin = case.organ.bounds.mean(axis=0)
        tissue = tissue_of(case, setup)
        tool = ConvexTool.cuboid(case.size_mm, case.edge_radius_mm)
        shapes = [static_shape(moved_by(case.support, -self.origin), tissue), tool]
        contact = Contact(shape_friction=case.friction)
        self.solver = build_solver(rest or _organ(case), tissue, shapes, tool, contact)
        self.body, self.model, self.contacts = self.solver.body, self.solver.model, self.solver.contacts
        self.beads = Skin(self.model, case.beads - self.origin)

    def run(self, setup: Setup) -> BeadRun:
        """Press the organ from its stress-free shape.

        It settles for the warm-up's 120 steps with the probe away, as at its stage-0 place the probe would be in the way
        of an organ that is not yet down. Then each stage takes 90 steps: in the first 60 the probe goes evenly to its
        pose of that stage (to that of stage 0 along the press), in the others it rests. The same setup
        gives the same beads, whatever ran before.
        """
        step = self.prepare(setup)
        pose = self._away()
        run = BeadRun(np.zeros_like(self.case.measured), arriving=np.zeros_like(self.case.measured))
        moving = max(1, round(MOVING * setup.stage_steps))
        for stage, goal in enumerate(self.case.poses):
            path = poses_between(pose, self.relative(goal), moving)
            for n in range(setup.stage_steps):
                poses = poses_between(path[min(n, moving)], path[min(n + 1, moving)], step.substeps)
                timed(lambda: self.solver.step(step, poses), run.step_ms)
                if n + 1 == moving:
                    run.arriving[stage] = self._found()
            pose = path[-1]
            run.beads[stage] = self._found()
            run.finite &= bool(np.isfinite(array_of(self.body.position)).all())
        run.finite &= bool(np.isfinite(run.beads).all())
        return run

    def prepare(self, setup: Setup) -> StepSettings:
        """From the stress-free shape through the warm-up, the probe away; the settings of its steps."""
        self._restore()
        step, pose = self._step_settings(setup), self._away()
        for _ in range(setup.warm_up_steps):
            self.solver.step(step, poses_between(pose, pose, step.substeps))
        return step

    def _found(self) -> np.ndarray:
        self.beads.update()
        return array_of(self.beads.vertices) + self.origin

    def relative(self, pose: np.ndarray) -> np.ndarray:
        """A pose (4, 4) of the case's frame, in the device's."""
        moved = pose.copy()
        moved[:3, 3] -= self.origin
        return moved

    def size(self, setup: Setup) -> dict[str, float]:
        """How large the model is, under the names of a report: ``radius_mm`` or ``cell_mm``, ``particles`` or ``nodes``."""
        return {setup.tissue.SIZE: setup.size_mm, **self.model.counts()}

    def describe(self, setup: Setup) -> str:
        """Size and settings in the model's own words, for the terminal."""
        tissue = tissue_of(self.case, setup)
        return tissue.REPORTED.format(**tissue.model_dump(), **self.model.counts())

    def _restore(self) -> None:
        self.body.restore(self.body.rest_state())
        self.contacts.reset()
        self.model.update_frames()

    def _step_settings(self, setup: Setup) -> StepSettings:
        x, y, z = self.case.gravity.tolist()
        return replace(step_settings(tissue_of(self.case, setup), setup.solver), gravity=(x, y, z))

    def _away(self) -> np.ndarray:
        pose = self.relative(self.case.poses[0])
        pose[:3, 3] -= AWAY_MM * self.case.press_direction
        return pose


def tissue_of(case: BeadCase, setup: Setup) -> TissueSection:
    """The setup's tissue with what is the case's own. Raises SetupError where neither gives the material."""
    tissue, density = setup.tissue, (case.density_kg_m3 or DENSITY_KG_M3) / 1000
    material = dict(young_kpa=case.young_kpa, poisson=case.poisson, density_g_cm3=density)
    told = {name: value for name, value in material.items() if name in type(tissue).model_fields}
    told |= tissue.model_dump(exclude_unset=True)
    if None in told.values():
        raise SetupError(
            f"{case.name}: the case does not say what its tissue is; give --young-kpa and --poisson"
        )
    return type(tissue).model_validate(told)


def rest_body(case: BeadCase, setup: Setup) -> RestBody:
    """Shape matching's particles of a case; Experiments of one radius can share them."""
    return fill_organ(_organ(case), setup.tissue)


def _organ(case: BeadCase) -> trimesh.Trimesh:
    return moved_by(case.organ, -case.organ.bounds.mean(axis=0))
