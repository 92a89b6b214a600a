"""A bead experiment on the device: the warm-up, then the press stage by stage."""

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh

from rehearsal.build_solver import build_solver, static_shape, step_settings
from rehearsal.configuration import Setup, SetupError
from rehearsal.stopwatch import timed
from scenes.scene import Contact
from scenes.surfaces import translated
from scenes.tissue import TissueSection
from sim.fields import array_of
from sim.sampling import RestBody
from sim.shape_matching import fill_organ
from sim.shapes import ConvexTool
from sim.skinning import Skin
from sim.solver import StepSettings
from sim.surface_contact import SurfaceContacts
from studies.accuracy.bead_case import DENSITY_KG_M3, BeadCase
from studies.harness import positions_of
from ultrasound.probe_manipulator import poses_between

# Share of a stage's steps in which the probe moves; in the others the tissue comes to rest, as before the
# scan.
MOVING = 2 / 3
# Distance of the probe, back along the press, while the organ settles.
AWAY_MM = 60.0


@dataclass
class BeadRun:
    """One run: ``beads`` (stages, n, 3) [mm] at the end of each stage, and ``arriving`` when the probe has
    just arrived; the tissue's force on the probe ``force_n`` (stages, 3) [N], ``sliding_share`` and
    ``friction_ratio`` (stages,) as in ``sim.surface_contact.ContactLoad``, NaN for a model that has none; the
    centroids ``parts_mm`` (stages, parts, 3) of the parts; the time of each step in the stages, and whether
    all positions are finite.
    """

    beads: np.ndarray
    step_ms: list[float] = field(default_factory=list)
    finite: bool = True
    arriving: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    force_n: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    sliding_share: np.ndarray = field(default_factory=lambda: np.zeros(0))
    friction_ratio: np.ndarray = field(default_factory=lambda: np.zeros(0))
    parts_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))


class BeadExperiment:
    """A case on the device, for setups that share model, size and material; Taichi must be initialised.

    Positions on the device are relative to ``origin``, the middle of the organ. Raises SamplingError and
    SetupError.
    """

    def __init__(self, case: BeadCase, setup: Setup, rest: RestBody | None = None) -> None:
        self.case = case
        self.origin = case.organ.bounds.mean(axis=0)
        tissue = tissue_of(case, setup)
        tool = ConvexTool.cuboid(case.size_mm, case.edge_radius_mm)
        shapes = [static_shape(translated(case.support, -self.origin), tissue), tool]
        contact = Contact(shape_friction=case.friction)
        parts = [replace(part, surface=translated(part.surface, -self.origin)) for part in case.parts]
        fixed = [replace(region, at_mm=region.at_mm - self.origin) for region in case.fixed]
        self.solver = build_solver(
            rest or _organ(case), tissue, shapes, tool, contact, fixed=fixed, parts=parts
        )
        self.body, self.model = self.solver.body, self.solver.model
        self.parts = [(Skin(self.model.carrier, part.surface.vertices), part.surface.faces) for part in parts]
        self.beads = Skin(self.model.carrier, case.beads - self.origin)

    def run(self, setup: Setup) -> BeadRun:
        """Press the organ from its stress-free shape.

        It settles with the probe away: at stage 0 the probe would touch an organ that has not yet sunk into
        its support. In each stage the probe moves at constant speed to its pose and rests. The same setup
        gives the same beads.
        """
        step = self.prepare(setup)
        pose = self._away()
        nothing = np.zeros_like(self.case.measured)
        run = BeadRun(nothing, arriving=nothing.copy(), force_n=np.full((len(nothing), 3), np.nan))
        run.sliding_share, run.friction_ratio = np.full((2, len(nothing)), np.nan)
        run.parts_mm = np.zeros((len(nothing), len(self.case.parts), 3))
        moving = max(1, round(MOVING * setup.stage_steps))
        for stage, goal in enumerate(self.case.poses):
            path = poses_between(pose, self.relative(goal), moving)
            for n in range(setup.stage_steps):
                poses = poses_between(path[min(n, moving)], path[min(n + 1, moving)], step.substeps)
                timed(lambda: self.solver.step(step, poses), run.step_ms)
                if n + 1 == moving:
                    run.arriving[stage] = self._bead_positions()
            pose = path[-1]
            run.beads[stage] = self._bead_positions()
            run.parts_mm[stage] = self._part_centroids()
            if isinstance(self.model.contacts, SurfaceContacts):
                load = self.model.contacts.load(self.solver.tool, pose[:3, 3])
                run.force_n[stage] = load.wrench[:3]
                run.sliding_share[stage], run.friction_ratio[stage] = load.sliding_share, load.friction_ratio
            run.finite &= bool(np.isfinite(positions_of(self.solver)).all())
        run.finite &= bool(np.isfinite(run.beads).all())
        return run

    def prepare(self, setup: Setup) -> StepSettings:
        """Warm up from the stress-free shape, with the probe away; return the settings of its steps."""
        self.solver.restart()
        x, y, z = self.case.gravity.tolist()
        step = replace(step_settings(tissue_of(self.case, setup), setup.solver), gravity=(x, y, z))
        pose = self._away()
        for _ in range(setup.warm_up_steps):
            self.solver.step(step, poses_between(pose, pose, step.substeps))
        return step

    def _bead_positions(self) -> np.ndarray:
        self.beads.update()
        return array_of(self.beads.vertices) + self.origin

    def _part_centroids(self) -> np.ndarray:
        """Present centroids (parts, 3) [mm] of the parts' volumes."""
        centroids = np.zeros((len(self.parts), 3))
        for centroid, (skin, faces) in zip(centroids, self.parts, strict=True):
            skin.update()
            corner = array_of(skin.vertices)[faces].astype(float)
            six_volumes = np.einsum("fi,fi->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
            centroid[:] = six_volumes @ corner.sum(axis=1) / 4 / six_volumes.sum() + self.origin
        return centroids

    def relative(self, pose: np.ndarray) -> np.ndarray:
        """A pose (4, 4) of the case's frame, in that of the device."""
        moved = pose.copy()
        moved[:3, 3] -= self.origin
        return moved

    def size(self, setup: Setup) -> dict[str, float]:
        """Size of the model, under a report's names: ``radius_mm`` or ``cell_mm``, and its counts."""
        return {setup.tissue.size_key: setup.size_mm, **self.model.counts()}

    def describe(self, setup: Setup) -> str:
        """Size and settings of the model, in words."""
        tissue = tissue_of(self.case, setup)
        return tissue.report_line.format(**tissue.model_dump(), **self.model.counts())

    def _away(self) -> np.ndarray:
        pose = self.relative(self.case.poses[0])
        pose[:3, 3] -= AWAY_MM * self.case.press_direction
        return pose


def tissue_of(case: BeadCase, setup: Setup) -> TissueSection:
    """The setup's tissue with the case's material. Raises SetupError where neither gives the material."""
    tissue, density = setup.tissue, (case.density_kg_m3 or DENSITY_KG_M3) / 1000
    material = dict(young_kpa=case.young_kpa, poisson=case.poisson, density_g_cm3=density)
    known = {name: value for name, value in material.items() if name in type(tissue).model_fields}
    known |= tissue.model_dump(exclude_unset=True)
    if None in known.values():
        raise SetupError(f"{case.name}: the case has no material; give --young-kpa and --poisson")
    return type(tissue).model_validate(known)


def rest_body(case: BeadCase, setup: Setup) -> RestBody:
    """The particles of a case for shape matching; experiments of one radius can share them."""
    return fill_organ(_organ(case), setup.tissue)


def _organ(case: BeadCase) -> trimesh.Trimesh:
    return translated(case.organ, -case.organ.bounds.mean(axis=0))
