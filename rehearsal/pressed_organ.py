"""An organ under its probe, advanced step by step: the part of a rehearsal that a process of its own can
compute.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import numpy as np
import trimesh

from rehearsal.build_solver import build_solver, static_shape, step_settings, tool_of
from rehearsal.case import TUMOUR, Case
from rehearsal.resection.cut import Cut
from rehearsal.resection.score_line import ResectionError
from rehearsal.stopwatch import timed
from scenes.anatomy import Grid
from scenes.mechanical_tissues import mechanical_properties
from scenes.perirenal_fat import foundation_kpa_mm
from scenes.scene import Attachment, Gravity, PlaneShape, SceneError, SolverSection
from scenes.surfaces import translated
from scenes.tissue import PartMaterial, PartName, TissueSection
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
from sim.surface_contact import ContactLoad, SurfaceContacts
from sim.viscoelasticity import Relaxation
from ultrasound.probe_manipulator import advanced, array_face_centre, poses_between

AWAY_MM = 200.0
# How deep what presses of the probe may move into the tissue in a step, before the tissue yields.
MOST_PENETRATION_MM = 0.25
# Round tissue the proxy's path is bent. Of a longer one the solver, for which a path is straight, has the end
# alone.
MOST_STRAIGHT_MM = 3.0
# So is that of a point round which the tool turns on the way.
MOST_SAGITTA_MM = 0.3
# Force of a probe that only touches.
TOUCH_N = 0.1
# Stiffness of the virtual coupling of hand and probe: the nearer the force is to its limit, the less the
# probe may move on in a step.
COUPLING_N_MM = 5.0


@dataclass(frozen=True)
class OrganState:
    """What steps change: the tissue, the divergence check, the transducer's pose (4, 4)."""

    solver: SolverState
    divergence: DivergenceState
    pose: np.ndarray
    steps: int


class PressedOrgan:
    """The solver of a case's organ under its probe.

    ``pose`` (4, 4) is the transducer's, ``hand`` that which it follows. Taichi must be initialised, and
    initialised again for another case, which frees this one. ``on_wrench`` is
    called after each ``timed_step`` with the transducer's pose (4, 4) and the ``wrench``, at the rate of the
    steps: for a haptic device. ``serial`` says whether a step is computed on one core; left open, the body's
    size and the machine decide.
    """

    on_wrench: Callable[[np.ndarray, np.ndarray], None] | None = None
    pose: np.ndarray
    hand: np.ndarray

    def __init__(self, case: Case, serial: bool | None = None) -> None:
        self.case = case
        self.cut: Cut | None = None
        self._build_solver(serial)
        self.divergence_check = DivergenceCheck(self.solver)
        self.notice = ""
        self.steps = 0
        self.place(advanced(case.press_pose, -AWAY_MM))

    def _build_solver(self, serial: bool | None) -> None:
        case = self.case
        self.tool = tool_of(case.probe)
        shapes = [*(self._shape(shape) for shape in case.shapes), self.tool]
        tissue, section = case.scene.tissue, case.scene.solver
        fixed, tethers = attachments_of(case, case.scene.attachment)
        self.parts_of_tissue = parts_of(case)
        self.solver = build_solver(
            case.organ,
            tissue,
            shapes,
            self.tool,
            case.scene.contact,
            section,
            serial,
            fixed=fixed,
            tethers=tethers,
            parts=self.parts_of_tissue,
        )
        self.body, self.model, self.contacts = self.solver.body, self.solver.model, self.solver.contacts
        self.proxy = self.contacts.proxy(self.tool)
        self.settings = step_settings(tissue, section)
        self.young_kpa: float | None = getattr(tissue, "young_kpa", None)
        self._set_gravity(case.scene.gravity)

    def _shape(self, shape: PlaneShape | trimesh.Trimesh | Grid) -> Plane | SignedDistanceField:
        if isinstance(shape, PlaneShape):
            normal = np.array(shape.normal) / np.linalg.norm(shape.normal)
            return Plane(normal, shape.offset_mm / np.linalg.norm(shape.normal) - normal @ self.case.origin)
        if isinstance(shape, trimesh.Trimesh):
            return static_shape(translated(shape, -self.case.origin), self.case.scene.tissue)
        spacing = 1 / np.diag(shape.index_from_mm)[:3]
        return SignedDistanceField(
            shape.voxels, -spacing * shape.index_from_mm[:3, 3] - self.case.origin, spacing
        )

    def settle(self) -> OrganState:
        """Let the organ come to rest on its support with the transducer far away: the paper's warm-up. Return
        that state.

        It is computed once for the same scene, probe and anatomy.
        """
        position, velocity, *internal_state = stored(self._warm_up, *self._inputs(), backend=backend())
        names = self.solver.snapshot().internal_state
        self.solver.restore(
            SolverState(BodyState(position, velocity), dict(zip(names, internal_state, strict=True)))
        )
        self.steps = 0
        self.divergence_check.set_initial_state()
        return self.snapshot()

    def _warm_up(self, *inputs: object) -> tuple[np.ndarray, ...]:
        """The state at rest: positions, velocities and internal variables. The inputs are those of the organ
        itself.
        """
        self.come_to_rest()
        state = self.solver.snapshot()
        return state.body.position, state.body.velocity, *state.internal_state.values()

    def come_to_rest(self) -> None:
        """The paper's warm-up, from the present state.

        The patient has lain for long, so that the tissue relaxes wholly.
        """
        relaxation = getattr(self.model, "relaxation", None)
        for _ in range(self.case.press.warm_up_steps):
            self.advance(self.pose)
            if isinstance(relaxation, Relaxation):
                relaxation.complete()

    def _inputs(self) -> Iterator[object]:
        """All that the state at rest depends on."""
        sections = self.case.scene.model_dump_json(include={"tissue", "solver", "contact", "attachment"})
        yield from (
            sections,
            repr(self.settings),
            self.young_kpa,
            self.case.press.warm_up_steps,
            int(self.model.serial),
        )
        yield from (
            self.case.probe.model_dump_json(),
            self.case.organ,
            self.case.tumour,
            self.case.fat_mm,
            self.case.origin,
            self.pose,
            repr(self.case.press.direction),
        )
        for part in self.parts_of_tissue:
            yield from (part.surface, repr(part.material))
        for shape in self.case.shapes:
            if isinstance(shape, Grid):
                yield from (shape.voxels, shape.index_from_mm)
            elif isinstance(shape, trimesh.Trimesh):
                yield shape
            else:
                yield shape.model_dump_json()

    def set(self, tissue: TissueSection, section: SolverSection, gravity: Gravity) -> None:
        """Change what steps depend on: Young's modulus or stiffness, substeps, iterations, gravity.

        The direction of gravity stays the scene's.
        """
        step = step_settings(tissue, section)
        self.settings.substeps, self.settings.iterations = step.substeps, step.iterations
        self.settings.stiffness = step.stiffness
        self._set_gravity(gravity)
        young_kpa = getattr(tissue, "young_kpa", None)
        if young_kpa != self.young_kpa and hasattr(self.model, "set_material"):
            self.young_kpa = young_kpa
            self.model.set_material(young_kpa)

    def _set_gravity(self, gravity: Gravity) -> None:
        self.settings.gravity = tuple(1000.0 * gravity.acceleration_m_s2 * self.case.gravity_direction)

    @contextmanager
    def step_of(self, length_s: float, iterations: int) -> Iterator[None]:
        """Settings of single steps that differ from those of the scene."""
        usual = self.settings.time_step_s, self.settings.iterations
        self.settings.time_step_s, self.settings.iterations = length_s, iterations
        try:
            yield
        finally:
            self.settings.time_step_s, self.settings.iterations = usual

    def advance(self, hand: np.ndarray, presses: bool = True) -> None:
        """Advance one time step, in which the transducer follows a hand at a pose (4, 4) as far as the tissue
        lets it; unless it ``presses``, it only touches.

        ``notice`` is the message of the divergence check if it restored the state, else empty. The transducer
        then has moved back along its axis to where it touches.
        """
        pose = self._proxy_of(hand, presses)
        path = poses_between(self._start_of_path(pose, pose is hand), pose, self.settings.substeps)
        self.solver.step(self.settings, path)
        self.notice = self.divergence_check.check(self.settings.time_step_s)
        if self.notice:
            # The restored tissue may be where the transducer is now.
            pose = self.proxy.pose_towards(advanced(pose, -AWAY_MM), pose, 0.0, presses=False)
        self.pose, self.hand = pose, hand
        self.steps += 1

    def _start_of_path(self, pose: np.ndarray, is_free: bool) -> np.ndarray:
        """Where the transducer's path to a pose (4, 4) starts for the solver: at the present pose, or at the
        pose itself where the path is not straight for the tissue, which the proxy has kept out of it.
        """
        length_mm = float(np.linalg.norm(pose[:3, 3] - self.pose[:3, 3]))
        cosine = (np.trace(pose[:3, :3] @ self.pose[:3, :3].T) - 1) / 2
        turn = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        sagitta_mm = (length_mm + self.tool.ball_mm * turn) * turn / 8
        is_straight = sagitta_mm < MOST_SAGITTA_MM and (is_free or length_mm <= MOST_STRAIGHT_MM)
        return self.pose if is_straight else pose

    def _proxy_of(self, hand: np.ndarray, presses: bool) -> np.ndarray:
        """The transducer's next pose (4, 4), within the limits of force and penetration."""
        limit_n = self.case.scene.transducer.force_limit_n if presses else TOUCH_N
        wrench = self.wrench()
        goal = hand if wrench is None else within_force(self.pose, hand, wrench[:3], limit_n)
        return self.proxy.pose_towards(self.pose, goal, MOST_PENETRATION_MM if presses else 0.0, presses)

    def timed_step(
        self,
        hand: np.ndarray,
        length_s: float | None = None,
        iterations: int | None = None,
        presses: bool = True,
    ) -> tuple[float, np.ndarray | None]:
        """As ``advance``, by a step of a length [s] with so many iterations, where given; return the time
        that it took [ms], and the wrench.
        """
        took_ms: list[float] = []
        with self.step_of(length_s or self.settings.time_step_s, iterations or self.settings.iterations):
            timed(partial(self.advance, hand, presses), took_ms)
        wrench = self.wrench()
        if self.on_wrench is not None and wrench is not None:
            self.on_wrench(self.pose, wrench)
        return took_ms[0], wrench

    def wrench(self) -> np.ndarray | None:
        """Force (3,) [N] of the tissue on the probe after the last step, and its torque (3,) [N mm] about the
        centre of the array face, along the patient's axes (LPS); None for a tissue model whose contacts have
        no forces.
        """
        load = self.load()
        return None if load is None else load.wrench

    def load(self) -> ContactLoad | None:
        """The load on the probe after the last step: its ``wrench``, as above, and how much of the contact
        slides; None for a tissue model whose contacts have no forces.
        """
        if not isinstance(self.contacts, SurfaceContacts):
            return None
        return self.contacts.load(self.tool, array_face_centre(self.pose, self.case.size_mm[2]))

    def place(self, pose: np.ndarray) -> None:
        """Have the transducer at a pose (4, 4) at once, where no tissue is."""
        self.pose = self.hand = pose

    def snapshot(self) -> OrganState:
        """A copy of the present state."""
        return OrganState(self.solver.snapshot(), self.divergence_check.state, self.pose, self.steps)

    def restore(self, state: OrganState) -> None:
        """Restore a state; the steps that follow give the same bits as before."""
        self.solver.restore(state.solver)
        self.divergence_check.state = state.divergence
        self.place(state.pose)
        self.steps = state.steps

    def store_valid_state(self) -> None:
        """Make the present tissue, if it is valid, the state that the divergence check restores."""
        self.divergence_check.store_if_healthy()

    def check_can_be_cut(self) -> None:
        """Raises ResectionError for a tissue model that cannot be cut."""
        if not isinstance(self.model, NeoHookean):
            raise ResectionError(
                f"tissue of the model {self.case.scene.tissue.model} cannot be cut; choose --model "
                "neo-hookean"
            )

    def apply_cut(self, cut: Cut | None) -> None:
        """Cut the whole organ, or with None restore it.

        The tissue's state stays as it is. Raises ResectionError.
        """
        if cut is self.cut:
            return
        self.check_can_be_cut()
        model: Any = self.model
        parts = [part.surface for part in self.parts_of_tissue]
        tissue = None if cut is None else RemovedTissue(cut.specimen, cut.remnant, cut.on_remnant)
        model.remove_tissue(self.case.organ, tissue, parts)
        lattice = model.lattice
        self.divergence_check.test_among(lattice.node_mass(np.ones(len(lattice.cells))) > 0)
        self.cut = cut

    def digest(self) -> str:
        """A hash of the tissue's state: it changes with every bit."""
        state = self.body.snapshot()
        return hashlib.sha256(state.position.tobytes() + state.velocity.tobytes()).hexdigest()[:16]


def within_force(pose: np.ndarray, goal: np.ndarray, force_n: np.ndarray, limit_n: float) -> np.ndarray:
    """A goal (4, 4) of the transducer at a pose (4, 4) [mm], moved so that the force (3,) [N] of the tissue
    on it stays within a limit.
    """
    size_n = float(np.linalg.norm(force_n))
    if size_n < 1e-9:
        return goal
    outward = force_n / size_n
    most_mm = (limit_n - size_n) / COUPLING_N_MM
    beyond_mm = outward @ (pose[:3, 3] - goal[:3, 3]) - max(most_mm, -MOST_PENETRATION_MM)
    if beyond_mm <= 0.0:
        return goal
    moved = goal.copy()
    moved[:3, 3] += beyond_mm * outward
    return moved


def attachments_of(case: Case, attachment: Attachment) -> tuple[list[FixedRegion], list[Tether]]:
    """What an attachment of a case's organ fixes and what holds it elastically, relative to its origin; the
    surgeon comes from where the probe does, unless the attachment names the approach.
    """
    fixed: list[FixedRegion] = []
    tethers: list[Tether] = []
    if attachment.radius_mm > 0 and attachment.at_mm is not None:
        place = np.array(attachment.at_mm) - case.origin, attachment.radius_mm
        if attachment.stiffness_n_mm > 0:
            tethers.append(Pedicle(*place, attachment.stiffness_n_mm))
        else:
            fixed.append(FixedRegion(*place))
    if attachment.has_fat:
        approach = -np.array(case.press.direction)
        around = attachment, case.organ, case.tumour, case.fat_mm, approach
        tethers.append(PerirenalFat(foundation_kpa_mm(*around)))
    return fixed, tethers


def parts_of(case: Case) -> list[Part]:
    """The parts of the organ that have their own material, in the order of ``PartName``.

    Raises SceneError.
    """
    materials = getattr(case.scene.tissue, "parts", {})
    surfaces = {**case.parts, **({} if case.tumour is None else {TUMOUR: case.tumour})}
    parts = []
    for name in get_args(PartName):
        if name in materials:
            if name not in surfaces:
                raise SceneError(f"tissue.parts.{name}: this patient has no {name}; leave it out")
            parts.append(Part(name, surfaces[name], material_of(name, materials[name])))
    return parts


def material_of(name: str, own: PartMaterial) -> Material:
    """The material of a part: what is given, and what is typical of it."""
    typical = mechanical_properties().parts[name]
    return Material(
        *(
            getattr(typical, key)[1] if getattr(own, key) is None else getattr(own, key)
            for key in ("young_kpa", "poisson", "density_g_cm3")
        )
    )
