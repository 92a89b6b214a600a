"""An organ under its probe, advanced step by step: the part of a rehearsal that a process of its own can compute."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import get_args

import numpy as np
import trimesh

from rehearsal.build_solver import build_solver, static_shape, step_settings, tool_of
from rehearsal.configuration import probe_of
from rehearsal.resection.cut import Cut
from rehearsal.resection.score_line import ResectionError
from rehearsal.stopwatch import timed
from scenes.anatomy import Grid, LoadedAnatomy, press_on
from scenes.mechanical_tissues import mechanical_properties
from scenes.scene import Attachment, PlaneShape, Scene, SceneError
from scenes.surfaces import translated
from scenes.tissue import PartMaterial, PartName
from sim.attachment import FixedRegion, Pedicle, PerirenalFat, Tether
from sim.body import BodyState
from sim.device import backend
from sim.divergence_check import DivergenceCheck, DivergenceState
from sim.material import Material, Part
from sim.neo_hookean import NeoHookean
from sim.removed_tissue import RemovedTissue
from sim.shapes import Plane, SignedDistanceField
from sim.solver import SolverState
from sim.stored_arrays import stored
from sim.surface_contact import SurfaceContacts
from sim.viscoelasticity import Relaxation
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import advanced, array_face_centre, pose_at, poses_between

AWAY_MM = 200.0


@dataclass(frozen=True)
class OrganState:
    """What steps change: the tissue, the divergence check, the transducer's pose (4, 4)."""

    solver: SolverState
    divergence: DivergenceState
    pose: np.ndarray
    steps: int


@dataclass(frozen=True)
class Step:
    """A step that was made: the transducer's pose (4, 4) at its end, its length [s], its iterations, the time that it took [ms].

    ``notice`` is the message of the divergence check if it restored the state. Where the steps follow a clock, ``input_s`` is the time
    of the input that the pose shows, ``late_ms`` how much later than due the step began, and ``pace`` says how it differs from what is
    set. ``awaited`` says whether it waited for its input, because steps had to become long. ``wrench`` is that of ``PressedOrgan.wrench``.
    """

    pose: np.ndarray
    length_s: float
    iterations: int
    took_ms: float
    notice: str = ""
    input_s: float = 0.0
    late_ms: float = 0.0
    pace: str = ""
    awaited: bool = False
    wrench: np.ndarray | None = None


class PressedOrgan:
    """The solver of a scene's organ. All positions are mm relative to ``origin``, the middle of the resting organ (LPS).

    Taichi must be initialised, and initialised again for another scene, which frees this one. ``on_wrench`` is called after each timed step
    with the transducer's pose (4, 4) and its ``wrench``, at the rate of the steps: for a haptic device. ``serial`` says whether a step is
    computed on one core; left open, the body's size and the machine decide.
    """

    on_wrench: Callable[[np.ndarray, np.ndarray], None] | None = None

    def __init__(
        self, scene: Scene, anatomy: LoadedAnatomy, probe: Probe | None = None, serial: bool | None = None
    ) -> None:
        self.scene = scene
        self.probe = probe or probe_of(scene)
        self.origin = anatomy.organ.bounds.mean(axis=0)
        self.whole_organ = translated(anatomy.organ, -self.origin)
        self.gravity_direction = np.array(scene.gravity.direction) / np.linalg.norm(scene.gravity.direction)
        self.press = press_on(scene.press, anatomy, self.gravity_direction)
        self.cut: Cut | None = None
        self._build_solver(anatomy, serial)
        self._shapes = anatomy.shapes
        self.divergence_check = DivergenceCheck(self.solver)
        self.notice = ""
        self.steps = 0
        self.pose = advanced(self._press_pose(), -AWAY_MM)

    @property
    def organ(self) -> trimesh.Trimesh:
        """The organ's surface at rest: after a cut, of what remains."""
        return self.whole_organ if self.cut is None else self.cut.remnant

    def _build_solver(self, anatomy: LoadedAnatomy, serial: bool | None) -> None:
        self.size_mm = np.array(self.probe.housing_mm)
        self.tool = tool_of(self.probe)
        shapes = [*(self._shape(shape) for shape in anatomy.shapes), self.tool]
        tissue, section = self.scene.tissue, self.scene.solver
        fixed, tethers = attachments_of(self.scene.attachment, self.origin, np.array(self.press.direction))
        self.parts_of_tissue = parts_of(self.scene, anatomy, self.origin)
        self.solver = build_solver(
            self.whole_organ,
            tissue,
            shapes,
            self.tool,
            self.scene.contact,
            section,
            serial,
            fixed=fixed,
            tethers=tethers,
            parts=self.parts_of_tissue,
        )
        self.body, self.model, self.contacts = self.solver.body, self.solver.model, self.solver.contacts
        self.settings = step_settings(tissue, section)
        self.young_kpa: float | None = getattr(tissue, "young_kpa", None)
        self.set_gravity(self.scene.gravity.acceleration_m_s2)

    def _shape(self, shape: PlaneShape | trimesh.Trimesh | Grid) -> Plane | SignedDistanceField:
        if isinstance(shape, PlaneShape):
            normal = np.array(shape.normal) / np.linalg.norm(shape.normal)
            return Plane(normal, shape.offset_mm / np.linalg.norm(shape.normal) - normal @ self.origin)
        if isinstance(shape, trimesh.Trimesh):
            return static_shape(translated(shape, -self.origin), self.scene.tissue)
        spacing = 1 / np.diag(shape.index_from_mm)[:3]
        return SignedDistanceField(shape.voxels, -spacing * shape.index_from_mm[:3, 3] - self.origin, spacing)

    def _press_pose(self) -> np.ndarray:
        """The pose of the scripted press before it is moved to contact."""
        target = np.array(self.press.target_mm) - self.origin
        return pose_at(target, np.array(self.press.direction), np.array(self.press.lateral), self.size_mm[2])

    def settle(self) -> OrganState:
        """Let the organ come to rest on its support with the transducer far away: the paper's warm-up. Return that state.

        It is computed once for the same scene, probe and anatomy.
        """
        position, velocity, *history = stored(self._warm_up, *self._inputs(), backend=backend())
        names = self.solver.snapshot().history
        self.solver.restore(
            SolverState(BodyState(position, velocity), dict(zip(names, history, strict=True)))
        )
        self.steps = 0
        self.divergence_check.set_initial_state()
        return self.snapshot_of_organ()

    def _warm_up(self, *inputs: object) -> tuple[np.ndarray, ...]:
        """The state at rest: positions, velocities and history. The inputs are those of the organ itself."""
        self.come_to_rest()
        state = self.solver.snapshot()
        return state.body.position, state.body.velocity, *state.history.values()

    def come_to_rest(self) -> None:
        """The paper's warm-up, from the present state. The patient has lain for long, so that the tissue relaxes wholly."""
        relaxation = getattr(self.model, "relaxation", None)
        for _ in range(self.press.warm_up_steps):
            self.advance(self.pose)
            if isinstance(relaxation, Relaxation):
                relaxation.complete()

    def _inputs(self) -> Iterator[object]:
        """All that the state at rest depends on."""
        sections = self.scene.model_dump_json(include={"tissue", "solver", "contact", "attachment"})
        yield from (
            sections,
            repr(self.settings),
            self.young_kpa,
            self.press.warm_up_steps,
            int(self.model.serial),
        )
        yield from (
            self.probe.model_dump_json(),
            self.whole_organ,
            self.origin,
            self.pose,
            repr(self.press.direction),
        )
        for part in self.parts_of_tissue:
            yield from (part.surface, repr(part.material))
        for shape in self._shapes:
            if isinstance(shape, Grid):
                yield from (shape.voxels, shape.index_from_mm)
            elif isinstance(shape, trimesh.Trimesh):
                yield shape
            else:
                yield shape.model_dump_json()

    def set_gravity(self, acceleration_m_s2: float) -> None:
        """Change the acceleration due to gravity; its direction is the scene's."""
        self.settings.gravity = tuple(1000.0 * acceleration_m_s2 * self.gravity_direction)

    def set_young(self, young_kpa: float) -> None:
        """Change Young's modulus, if the tissue model has one."""
        if hasattr(self.model, "set_material"):
            self.young_kpa = young_kpa
            self.model.set_material(young_kpa)

    @contextmanager
    def step_of(self, length_s: float, iterations: int) -> Iterator[None]:
        """Settings of single steps that differ from those of the scene."""
        usual = self.settings.time_step_s, self.settings.iterations
        self.settings.time_step_s, self.settings.iterations = length_s, iterations
        try:
            yield
        finally:
            self.settings.time_step_s, self.settings.iterations = usual

    def advance(self, pose: np.ndarray) -> None:
        """Advance one time step, at whose end the transducer has a pose (4, 4).

        ``notice`` is the message of the divergence check if it restored the state, else empty.
        """
        self.solver.step(self.settings, poses_between(self.pose, pose, self.settings.substeps))
        self.notice = self.divergence_check.check(self.settings.time_step_s)
        self.pose = pose
        self.steps += 1

    def timed_step(
        self, pose: np.ndarray, length_s: float | None = None, iterations: int | None = None
    ) -> Step:
        """Advance by a step of a length [s] with so many iterations, where given, and return it."""
        took_ms: list[float] = []
        with self.step_of(length_s or self.settings.time_step_s, iterations or self.settings.iterations):
            timed(partial(self.advance, pose), took_ms)
            settings, wrench = self.settings, self.wrench()
            if self.on_wrench is not None and wrench is not None:
                self.on_wrench(pose, wrench)
            return Step(
                pose, settings.time_step_s, settings.iterations, took_ms[0], self.notice, wrench=wrench
            )

    def wrench(self) -> np.ndarray | None:
        """Force (3,) [N] of the tissue on the probe after the last step, and its torque (3,) [N mm] about the centre of the array face, along the
        patient's axes (LPS); None for a tissue model whose contacts have no forces.
        """
        if not isinstance(self.contacts, SurfaceContacts):
            return None
        return self.contacts.wrench(self.tool, array_face_centre(self.pose, self.size_mm[2]))

    def snapshot_of_organ(self) -> OrganState:
        """A copy of the present state."""
        return OrganState(self.solver.snapshot(), self.divergence_check.state, self.pose, self.steps)

    def restore_organ(self, state: OrganState) -> None:
        """Restore a state; the steps that follow give the same bits as before."""
        self.solver.restore(state.solver)
        self.divergence_check.state = state.divergence
        self.pose, self.steps = state.pose, state.steps

    def store_valid_state(self) -> None:
        """Make the present tissue, if it is valid, the state that the divergence check restores."""
        self.divergence_check.store_if_healthy()

    def apply_cut(self, cut: Cut | None) -> None:
        """Cut the whole organ, or with None restore it. The tissue's state stays as it is. Raises ResectionError."""
        if cut is self.cut:
            return
        if not isinstance(self.model, NeoHookean):
            raise ResectionError(
                f"tissue of the model {self.scene.tissue.model} cannot be cut; choose --model neo-hookean"
            )
        parts = [part.surface for part in self.parts_of_tissue]
        tissue = None if cut is None else RemovedTissue(cut.specimen, cut.remnant, cut.on_remnant)
        self.model.remove_tissue(self.whole_organ, tissue, parts)
        lattice = self.model.lattice
        self.divergence_check.test_among(lattice.node_mass(np.ones(len(lattice.cells))) > 0)
        self.cut = cut

    def digest(self) -> str:
        """A hash of the tissue's state: it changes with every bit."""
        state = self.body.snapshot()
        return hashlib.sha256(state.position.tobytes() + state.velocity.tobytes()).hexdigest()[:16]


def attachments_of(
    attachment: Attachment, origin: np.ndarray, press_direction: np.ndarray
) -> tuple[list[FixedRegion], list[Tether]]:
    """What a scene's attachment fixes and what holds it elastically, relative to an origin; fat leaves the pressed side free."""
    fixed: list[FixedRegion] = []
    tethers: list[Tether] = []
    if attachment.radius_mm > 0 and attachment.at_mm is not None:
        place = np.array(attachment.at_mm) - origin, attachment.radius_mm
        if attachment.stiffness_n_mm > 0:
            tethers.append(Pedicle(*place, attachment.stiffness_n_mm))
        else:
            fixed.append(FixedRegion(*place))
    if attachment.fat_kpa_mm > 0:
        tethers.append(PerirenalFat(attachment.fat_kpa_mm, -press_direction))
    return fixed, tethers


def parts_of(scene: Scene, anatomy: LoadedAnatomy, origin: np.ndarray) -> list[Part]:
    """The parts of the organ that have their own material, relative to an origin, in the order of ``PartName``."""
    asked = getattr(scene.tissue, "parts", {})
    surfaces = {**anatomy.parts, **({} if anatomy.tumour is None else {"tumour": anatomy.tumour})}
    found = []
    for name in get_args(PartName):
        if name in asked:
            if name not in surfaces:
                raise SceneError(f"tissue.parts.{name}: this patient has no {name}; leave it out")
            found.append(Part(name, translated(surfaces[name], -origin), material_of(name, asked[name])))
    return found


def material_of(name: str, given: PartMaterial) -> Material:
    """The material of a part: what is given, and what is typical of it."""
    typical = mechanical_properties().parts[name]
    return Material(
        *(
            getattr(typical, key)[1] if getattr(given, key) is None else getattr(given, key)
            for key in ("young_kpa", "poisson", "density_g_cm3")
        )
    )
