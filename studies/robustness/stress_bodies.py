"""The bodies of the stress test: each at rest, with its divergence check, its transducer and its surface."""

import json
from dataclasses import replace

import numpy as np
import trimesh

from rehearsal.build_solver import build_solver, step_settings
from rehearsal.configuration import PRESETS, scene_of, setup_of
from scenes.anatomy import load_anatomy
from scenes.scene import PAPER, Contact, SolverSection, load_scene
from scenes.surfaces import volume_mm3
from sim.divergence_check import DivergenceCheck
from sim.fields import array_of
from sim.neo_hookean import LATTICE_SETTINGS, NeoHookean
from sim.shapes import ConvexTool, Plane
from sim.skinning import Skin
from sim.solver import Solver, StepSettings
from studies.harness import block_of_cells, block_of_particles, positions_of, rehearsal_of, without_images
from studies.robustness.stress_cases import Subject
from studies.robustness.stress_motion import AWAY_MM
from ultrasound.probe_manipulator import advanced, pose_at, touching

# Bodies other than the kidney rest on a plane [mm].
ELLIPSOID_MM, BALL_MM, APART_MM = (30.0, 18.0, 15.0), 12.0, 40.0
SIZE_MM = {"neo-hookean": 6.0, "shape-matching": 3.3}
TRANSDUCER_MM = np.array([20.0, 6.0, 20.0])
DENSITY = 1.05e-3
DOWN = (0.0, 0.0, -9810.0)
# Steps between two checks of whether the body still moves.
SETTLE_STEPS, MOST_SETTLES, STILL_MM_S = 180, 20, 0.05


class Specimen:
    """A body at rest in its scene.

    ``home`` is the transducer's pose (4, 4) of first contact, ``parts`` the indices of the points of each
    separate piece, ``mass`` (n,) [g], ``rest`` (n, 3) [mm] the points at rest.
    """

    def __init__(
        self, solver: Solver, skin: Skin, mesh: trimesh.Trimesh, settings: StepSettings, home: np.ndarray
    ) -> None:
        self.solver, self.skin, self.settings, self.home = solver, skin, settings, home
        self.body, self.model = solver.body, solver.model
        self.faces, self.volume = np.asarray(mesh.faces), float(mesh.volume)
        self.parts = [np.arange(self.body.count)]
        gravity = np.array(settings.gravity)
        self.up = -gravity / np.linalg.norm(gravity)
        self.mass = self._masses()
        self.divergence_check = DivergenceCheck(solver)
        self.settled = self.divergence_check.initial
        self.rest = self.settled.body.position.astype(float)
        skin.update()
        surface = array_of(skin.vertices).astype(float)
        along = (surface - home[:3, 3]) @ home[:3, 2]
        self.thickness_mm = float(np.ptp(along))

    def _masses(self) -> np.ndarray:
        if isinstance(self.model, NeoHookean):
            return array_of(self.model.mass).astype(float)
        return np.full(self.body.count, DENSITY * self.volume / self.body.count)

    def advance(self, settings: StepSettings, poses: np.ndarray) -> str:
        """One step of the transducer over poses (substeps + 1, 4, 4); the message of the divergence check."""
        self.solver.step(settings, poses)
        return self.divergence_check.check(settings.time_step_s)

    def volume_ratio(self) -> float:
        """Volume inside the surface, as a share of that of the resting shape."""
        self.skin.update()
        return volume_mm3(array_of(self.skin.vertices), self.faces) / self.volume

    def kinetic_mj(self) -> float:
        """Kinetic energy [mJ]."""
        velocity = array_of(self.body.velocity).astype(float)
        return float(0.5e-6 * self.mass @ (velocity**2).sum(axis=1))

    def is_finite(self) -> bool:
        """Whether all positions are finite."""
        return bool(np.isfinite(positions_of(self.solver)).all())

    def rest_error_mm(self) -> float:
        """Mean distance [mm] of the points from their rest positions."""
        return float(np.linalg.norm(positions_of(self.solver) - self.rest, axis=1).mean())


def prepared(model: str, subject: Subject) -> Specimen:
    """A body at rest."""
    if subject.kind == "kidney":
        return _kidney(model, subject)
    mesh = _mesh(model, subject)
    tool = ConvexTool.cuboid(TRANSDUCER_MM)
    shapes = [Plane(np.array([0.0, 0.0, 1.0]), mesh.bounds[0, 2]), tool]
    if subject.kind in ("one", "cluster"):
        solver, settings = _block(model, 1 if subject.kind == "one" else 2, shapes, tool)
    else:
        solver, settings = _filled(model, subject, mesh, shapes, tool)
    skin = Skin(solver.model.carrier, mesh.vertices)
    settings.gravity = DOWN
    _settle(solver, settings, tool)
    skin.update()
    surface = array_of(skin.vertices).astype(float)
    top = surface[:, :2].mean(axis=0)
    pose = pose_at(np.array([*top, 100.0]), np.array([0.0, 0, -1]), np.array([1.0, 0, 0]), TRANSDUCER_MM[2])
    specimen = Specimen(solver, skin, mesh, settings, touching(pose, TRANSDUCER_MM, surface))
    if subject.kind == "two":
        specimen.parts = [np.flatnonzero(solver.body.rest_points[:, 0] * side > 0) for side in (-1, 1)]
    return specimen


def _kidney(model: str, subject: Subject) -> Specimen:
    scene, setup = load_scene(PAPER), PRESETS[model]["fast"]
    setup = setup.but(**json.loads(subject.tissue or "{}"))
    anatomy = without_images(load_anatomy(scene, PAPER.parent))
    rehearsal = rehearsal_of(scene_of(scene, setup), anatomy)
    # Recovery is measured from where the tissue has stopped moving.
    away = advanced(rehearsal.manipulator.home, -AWAY_MM)
    for _ in range(SETTLE_STEPS):
        rehearsal.advance(away)
    organ, surface = rehearsal.organ, rehearsal.case.organ
    skin = Skin(organ.model.carrier, surface.vertices)
    return Specimen(organ.solver, skin, surface, organ.settings, rehearsal.manipulator.home)


def _mesh(model: str, subject: Subject) -> trimesh.Trimesh:
    size = subject.size_mm or SIZE_MM[model]
    if subject.kind == "one" and model == "shape-matching":
        return trimesh.creation.icosphere(subdivisions=2, radius=size / 2)
    if subject.kind in ("one", "cluster"):
        side = size * (1 if subject.kind == "one" else 2)
        return trimesh.creation.box(bounds=[[0.0] * 3, [side] * 3])
    if subject.kind == "two":
        ball = trimesh.creation.icosphere(subdivisions=3, radius=BALL_MM)
        left, right = (ball.vertices + [x, 0.0, 0.0] for x in (-APART_MM / 2, APART_MM / 2))
        faces = np.concatenate([ball.faces, ball.faces + len(left)])
        return trimesh.Trimesh(np.concatenate([left, right]), faces, process=False)
    return trimesh.creation.icosphere(subdivisions=4).apply_scale(ELLIPSOID_MM)


def _filled(
    model: str, subject: Subject, mesh: trimesh.Trimesh, shapes: list, tool: ConvexTool
) -> tuple[Solver, StepSettings]:
    setup = setup_of(model).sized(subject.size_mm or SIZE_MM[model])
    tissue = scene_of(load_scene(PAPER), setup).tissue
    scaling = np.log(subject.mass_ratio) / np.ptp(mesh.bounds[:, 2])
    section = SolverSection(mass_scaling_per_mm=min(float(scaling), 1.0))
    contact = Contact(particles=subject.kind == "two" and tissue.supports_self_contact)
    return build_solver(mesh, tissue, shapes, tool, contact, section), step_settings(tissue, section)


def _block(model: str, side: int, shapes: list, tool: ConvexTool) -> tuple[Solver, StepSettings]:
    """One cell or particle, or two of them along each edge, which are one cluster."""
    size = SIZE_MM[model]
    if model == "neo-hookean":
        return block_of_cells(side, size, shapes, tool), replace(LATTICE_SETTINGS)
    points = size * (np.indices((side, side, side)).reshape(3, -1).T + (0.5 if side > 1 else 0.0))
    return block_of_particles(points, size, shapes, tool), StepSettings()


def _settle(solver: Solver, settings: StepSettings, tool: ConvexTool) -> None:
    away = advanced(np.eye(4), -AWAY_MM)
    tool.move(away, away)
    for _ in range(MOST_SETTLES):
        for _ in range(SETTLE_STEPS):
            solver.step(settings)
        # A single falling cell tumbles for seconds, on some processors longer than on others.
        if np.abs(array_of(solver.body.velocity)).max() < STILL_MM_S:
            return
