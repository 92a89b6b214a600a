"""One scene assembled: the body under its probe, advanced and imaged step by step.

The window, the headless run and every study use this class, so that they compute the same.
"""

import hashlib
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
import taichi as ti
import trimesh

from rehearsal.build_solver import build_solver, embedding_cell_mm, static_shape, step_settings, tool_of
from rehearsal.configuration import probe_of
from scenes.anatomy import Grid, LoadedAnatomy, press_on
from scenes.scene import PlaneShape, Scene
from scenes.surfaces import translated, volume_mm3
from scenes.terminal import ReportProgress, no_progress
from sim.divergence_check import DivergenceCheck, DivergenceState
from sim.embedding import Embedding
from sim.fields import array_of
from sim.shapes import Plane, SignedDistanceField
from sim.skinning import Skin
from sim.solver import SolverState
from sim.tissue_model import FixedRegion
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import (
    ImagePlane,
    ManipulatorState,
    ProbeManipulator,
    advanced,
    image_plane,
    pose_at,
    poses_between,
    touching,
)
from ultrasound.scanner import ScannedAnatomy, Scanner, plane_section, start_acoustics

AWAY_MM = 200.0
# Where the tumour protrudes, organ and tumour share a surface: the tumour's is drawn this far outside.
TUMOUR_LIFT_MM = 0.8
# Organ and support share a surface where they touch: the support is drawn this far inside.
SUPPORT_SUNK_MM = 0.4
# How far around the organ the surrounding tissue in the image moves with it.
SURROUNDINGS_MM = 25.0
# Points along each side of an image whose rest positions are computed.
REST_PLACES = 48


@dataclass(frozen=True)
class RehearsalState:
    """What changes: the tissue, the divergence check, the transducer's pose (4, 4), its manipulator."""

    solver: SolverState
    divergence: DivergenceState
    pose: np.ndarray
    steps: int
    manipulator: ManipulatorState


class Rehearsal:
    """A scene on the device. All positions are mm relative to ``origin``, the middle of the resting organ (LPS).

    Taichi must be initialised, and initialised again for another scene, which frees this one. ``progress`` is called with what is
    being built; ``needs_b_mode`` prepares the B-mode image meanwhile.
    """

    def __init__(
        self,
        scene: Scene,
        anatomy: LoadedAnatomy,
        probe: Probe | None = None,
        progress: ReportProgress = no_progress,
        needs_b_mode: bool = False,
    ) -> None:
        self.scene = scene
        self.probe = probe or probe_of(scene)
        self.origin = anatomy.organ.bounds.mean(axis=0)
        self.organ = translated(anatomy.organ, -self.origin)
        self.tumour = anatomy.tumour and translated(anatomy.tumour, -self.origin)
        self.parts = {tissue: translated(part, -self.origin) for tissue, part in anatomy.parts.items()}
        self.gravity_direction = np.array(scene.gravity.direction) / np.linalg.norm(scene.gravity.direction)
        meshes = [shape for shape in anatomy.shapes if isinstance(shape, trimesh.Trimesh)]
        self.supports = [_shrunk(translated(mesh, -self.origin), SUPPORT_SUNK_MM) for mesh in meshes]
        scanned, acoustics = None, None
        if anatomy.ct is not None:
            scanned = scanned_anatomy(self.organ, anatomy.ct, anatomy, self.origin)
            acoustics = start_acoustics(scanned) if needs_b_mode else None
        progress("Building the model: tissue and contacts")
        self._build_solver(anatomy)
        self.divergence_check = DivergenceCheck(self.solver)
        self.notice = ""
        progress("Building the model: surfaces")
        self._build_surfaces()
        self._build_scanner(scanned, acoustics)
        self.press = press_on(scene.press, anatomy, self.gravity_direction)
        self.steps = 0
        progress("Building the model: the tissue comes to rest")
        self.pose = self._settle()
        self.manipulator = self._manipulator()
        self.pose = self.manipulator.pose()
        self.divergence_check.set_initial_state()
        self.settled = self.snapshot()

    def _build_solver(self, anatomy: LoadedAnatomy) -> None:
        self.size_mm = np.array(self.probe.housing_mm)
        self.tool = tool_of(self.probe)
        shapes = [*(self._shape(shape) for shape in anatomy.shapes), self.tool]
        tissue, section = self.scene.tissue, self.scene.solver
        fixed = self._fixed_region()
        self.solver = build_solver(
            self.organ, tissue, shapes, self.tool, self.scene.contact, section, fixed=fixed
        )
        self.body, self.model, self.contacts = self.solver.body, self.solver.model, self.solver.contacts
        self.settings = step_settings(tissue, section)
        self.set_gravity(self.scene.gravity.acceleration_m_s2)

    def _fixed_region(self) -> FixedRegion | None:
        attachment = self.scene.attachment
        if attachment.radius_mm == 0 or attachment.at_mm is None:
            return None
        return FixedRegion(np.array(attachment.at_mm) - self.origin, attachment.radius_mm)

    def _shape(self, shape: PlaneShape | trimesh.Trimesh | Grid) -> Plane | SignedDistanceField:
        if isinstance(shape, PlaneShape):
            normal = np.array(shape.normal) / np.linalg.norm(shape.normal)
            return Plane(normal, shape.offset_mm / np.linalg.norm(shape.normal) - normal @ self.origin)
        if isinstance(shape, trimesh.Trimesh):
            return static_shape(translated(shape, -self.origin), self.scene.tissue)
        spacing = 1 / np.diag(shape.index_from_mm)[:3]
        return SignedDistanceField(shape.voxels, -spacing * shape.index_from_mm[:3, 3] - self.origin, spacing)

    def _build_surfaces(self) -> None:
        self.organ_skin = Skin(self.model, self.organ.vertices)
        self.tumour_skin = self._tumour_border = None
        if self.tumour is not None:
            self._tumour_border = Skin(self.model, self.tumour.vertices)
            drawn = self.tumour.vertices + TUMOUR_LIFT_MM * self.tumour.vertex_normals
            self.tumour_skin = Skin(self.model, drawn)
        self.part_skins = {tissue: Skin(self.model, part.vertices) for tissue, part in self.parts.items()}

    def _build_scanner(self, scanned: ScannedAnatomy | None, acoustics: Future[np.ndarray] | None) -> None:
        image = self.scene.image
        margin = SURROUNDINGS_MM if image.outside == "background" else 0.0
        self.embedding = Embedding(self.model, self.organ, embedding_cell_mm(self.scene.tissue), margin)
        self.scanner = None
        if scanned is not None:
            around = image.outside, image.contact, image.contact_gap_mm
            self.scanner = Scanner(scanned, self.embedding, self.probe, image.pixels, *around, acoustics)

    def _settle(self) -> np.ndarray:
        """Let the organ come to rest on its support with the transducer far away: the paper's warm-up."""
        target = np.array(self.press.target_mm) - self.origin
        pose = pose_at(target, np.array(self.press.direction), np.array(self.press.lateral), self.size_mm[2])
        self.pose = advanced(pose, -AWAY_MM)
        for _ in range(self.press.warm_up_steps):
            self.advance(self.pose)
        self.steps = 0
        self.update_surfaces()
        return pose

    def _manipulator(self) -> ProbeManipulator:
        settled = array_of(self.organ_skin.vertices).astype(float)
        faces = np.array(self.organ.faces, np.int64)
        normals = np.array(trimesh.Trimesh(settled, faces, process=False).vertex_normals)
        lateral, radius = np.array(self.press.lateral), self.probe.radius_mm
        speed = self.scene.transducer.speed_mm_s
        manipulator = ProbeManipulator(
            settled, faces, normals, self.size_mm, self.pose, lateral, radius, speed
        )
        manipulator.home = touching(self.pose, self.size_mm, manipulator.samples, radius)
        return manipulator

    def set_gravity(self, acceleration_m_s2: float) -> None:
        """Change the acceleration due to gravity; its direction is the scene's."""
        self.settings.gravity = tuple(1000.0 * acceleration_m_s2 * self.gravity_direction)

    def set_young(self, young_kpa: float) -> None:
        """Change Young's modulus, if the tissue model has one."""
        if hasattr(self.model, "set_material"):
            self.model.set_material(young_kpa)

    def scripted_pose(self, time_s: float) -> np.ndarray:
        """The transducer's pose at a time of the scripted press: touching at first, then deeper stage by stage."""
        depths = [0.0, *self.press.indentations_mm]
        stage = time_s / self.scene.solver.time_step_s / self.press.stage_steps
        return self.pose_at_depth(float(np.interp(stage, np.arange(len(depths)), depths)))

    def pose_at_depth(self, depth_mm: float) -> np.ndarray:
        """The transducer's pose at a depth of the scripted press."""
        return advanced(self.manipulator.home, depth_mm)

    def script_length_s(self) -> float:
        """Duration of the scripted press [s]."""
        return len(self.press.indentations_mm) * self.press.stage_steps * self.scene.solver.time_step_s

    def pose_towards(self, goal: np.ndarray) -> np.ndarray:
        """The transducer's next pose towards a goal (4, 4): at most at the scene's speed, and not through the organ."""
        return self.manipulator.pose_towards(goal, self.pose, self.settings.time_step_s)

    def advance(self, pose: np.ndarray) -> None:
        """Advance one time step, at whose end the transducer has a pose (4, 4).

        ``notice`` is the message of the divergence check if it restored the state, else empty.
        """
        self.solver.step(self.settings, poses_between(self.pose, pose, self.settings.substeps))
        self.notice = self.divergence_check.check(self.settings.time_step_s)
        self.pose = pose
        self.steps += 1

    def snapshot(self, manipulator: ManipulatorState | None = None) -> RehearsalState:
        """A copy of the present state, with the manipulator's present state or another one."""
        manipulator = manipulator or self.manipulator.state
        return RehearsalState(
            self.solver.snapshot(), self.divergence_check.state, self.pose, self.steps, manipulator
        )

    def restore(self, state: RehearsalState) -> None:
        """Restore a state; the steps that follow give the same bits as before."""
        self.solver.restore(state.solver)
        self.divergence_check.state = state.divergence
        self.pose, self.steps, self.manipulator.state = state.pose, state.steps, state.manipulator

    def store_valid_state(self) -> None:
        """Make the present tissue, if it is valid, the state that the divergence check restores."""
        self.divergence_check.store_if_healthy()

    def update_surfaces(self) -> None:
        """Move the drawn surfaces with the body."""
        self.organ_skin.update()
        if self.tumour_skin is not None:
            self.tumour_skin.update()
        for skin in self.part_skins.values():
            skin.update()

    def find_plane(self, probe: Probe) -> None:
        """Locate the image plane in the tissue without computing an image."""
        if self.scanner is not None:
            self.scanner.locate(self.image_plane(probe))

    def image_plane(self, probe: Probe | None = None) -> ImagePlane:
        """The present image plane, of the extent of the probe or of the probe with other settings."""
        return image_plane(self.pose, self.size_mm[2], *(probe or self.probe).extent_mm)

    def rest_grid(self) -> np.ndarray | None:
        """Rest positions (n, n, 3) [mm] of a grid over the last image; None without a CT."""
        return None if self.scanner is None else self.scanner.plane.rest_grid(REST_PLACES)

    def tumour_outline(self, at_rest: bool = False) -> np.ndarray | None:
        """The tumour's outline on the image plane, deformed or as in the CT: segments (n, 2, 2) on the plane [mm].

        None without a tumour.
        """
        if self.tumour is None:
            return None
        plane = self.image_plane()
        vertices = np.asarray(self.tumour.vertices) if at_rest else self.tumour_vertices()
        return plane_section(vertices, self.tumour.faces, np.linalg.inv(plane.world_from_plane))

    def tumour_vertices(self) -> np.ndarray:
        """Present vertices (n, 3) [mm] of the tumour's surface; empty without a tumour."""
        if self._tumour_border is None:
            return np.zeros((0, 3))
        self._tumour_border.update()
        return array_of(self._tumour_border.vertices).astype(float)

    def indentation_mm(self) -> float:
        """Depth of the transducer below the settled surface [mm]; negative above it."""
        return self.manipulator.indentation_mm(self.pose)

    def volume_ratio(self) -> float:
        """Volume inside the deformed surface relative to the one at rest."""
        carried = array_of(self.organ_skin.vertices)
        return float(volume_mm3(carried, self.organ.faces) / self.organ.volume)

    def reset(self) -> None:
        """Restore the start: tissue settled, transducer just touching."""
        self.restore(self.settled)
        ti.sync()

    def digest(self) -> str:
        """A hash of the tissue's state: it changes with every bit."""
        state = self.body.snapshot()
        return hashlib.sha256(state.position.tobytes() + state.velocity.tobytes()).hexdigest()[:16]


def _shrunk(mesh: trimesh.Trimesh, by_mm: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices - by_mm * mesh.vertex_normals, mesh.faces, process=False)


def scanned_anatomy(
    organ: trimesh.Trimesh, ct: Grid, anatomy: LoadedAnatomy, origin: np.ndarray
) -> ScannedAnatomy:
    """The anatomy as the scanner needs it, relative to an origin; the organ is already moved there."""
    labels = anatomy.labels
    shift = np.eye(4)
    shift[:3, 3] = origin
    label_values = None if labels is None else labels.voxels.astype(np.int32)
    tumour = anatomy.tumour and translated(anatomy.tumour, -origin)
    return ScannedAnatomy(organ, ct.voxels, ct.index_from_mm @ shift, label_values, anatomy.tissues, tumour)
