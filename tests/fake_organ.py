"""An organ of two points whose steps are arithmetic: all that a timeline needs of a ``PressedOrgan``, in
microseconds.
"""

import hashlib
from types import SimpleNamespace

import numpy as np

from rehearsal.loop.timeline import Timeline
from rehearsal.pressed_organ import OrganState
from scenes.scene import AnatomyFiles, Gravity, Scene, SolverSection
from scenes.tissue import TissueSection
from sim.body import BodyState
from sim.divergence_check import DivergenceState
from sim.solver import SolverState, StepSettings
from sim.surface_contact import ContactLoad

STEP_S = 0.125
# The transducer gets no lower than this, and where it only touches, no lower than the surface.
DEEPEST_MM, SURFACE_MM = -50.0, 0.0
PHANTOM = Scene(anatomy=AnatomyFiles(phantom=True), solver=SolverSection(iterations=4))


class FakeOrgan:
    """Each step depends on all that a step depends on: state, pose, length, iterations, stiffness of the
    material, the good state.
    """

    def __init__(self) -> None:
        self.case = SimpleNamespace(organ=None, tumour=None, parts={}, scene=PHANTOM)
        self.settings = StepSettings(time_step_s=STEP_S, iterations=4)
        self.young_kpa, self.gravity = 15.0, 9.81
        self.position, self.velocity = np.zeros((2, 3), np.float32), np.ones((2, 3), np.float32)
        self.friction = np.zeros(2, np.float32)
        self.steps, self.notice, self.cut = 0, "", None
        self.place(np.eye(4))
        self.model = SimpleNamespace(carrier=SimpleNamespace(interpolation=None))
        self.divergence_check = SimpleNamespace(set_initial_state=self.store_valid_state)
        self.store_valid_state()

    @property
    def body(self) -> SimpleNamespace:
        return SimpleNamespace(position=SimpleNamespace(memory=self.position))

    def _solver(self) -> SolverState:
        body = BodyState(self.position.copy(), self.velocity.copy())
        return SolverState(body, {"friction": self.friction.copy()})

    def store_valid_state(self) -> None:
        self.divergence = DivergenceState(self._solver())

    def snapshot(self) -> OrganState:
        return OrganState(self._solver(), self.divergence, self.pose, self.steps)

    def restore(self, state: OrganState) -> None:
        body = state.solver.body
        self.position, self.velocity = body.position.copy(), body.velocity.copy()
        self.friction = state.solver.internal_state["friction"].copy()
        self.divergence, self.steps = state.divergence, state.steps
        self.place(state.pose)

    def place(self, pose: np.ndarray) -> None:
        self.pose = self.hand = pose

    def timed_step(self, hand, length_s, iterations, presses) -> tuple[float, np.ndarray]:
        good, pose = self.divergence.good.body.position, hand.copy()
        pose[2, 3] = max(pose[2, 3], DEEPEST_MM if presses else SURFACE_MM)
        push = pose[:3, 3] * iterations + self.young_kpa - self.gravity + 0.1 * good + self.friction[:, None]
        self.velocity = (0.5 * self.velocity + length_s * push).astype(np.float32)
        self.position = (0.9 * self.position + length_s * self.velocity).astype(np.float32)
        self.friction += np.float32(iterations * length_s)
        self.pose, self.hand, self.steps = pose, hand, self.steps + 1
        return 1.0, self.wrench()

    def wrench(self) -> np.ndarray:
        return self.load().wrench

    def load(self) -> ContactLoad:
        return ContactLoad(np.full(6, self.position.sum(), np.float32), 0.25, 0.125)

    def digest(self) -> str:
        arrays = self.position, self.velocity
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:16]

    def set(self, tissue: TissueSection, section: SolverSection, gravity: Gravity) -> None:
        self.young_kpa, self.gravity = tissue.young_kpa, gravity.acceleration_m_s2
        self.settings.iterations = section.iterations

    def check_can_be_cut(self) -> None: ...
    def apply_cut(self, cut) -> None: ...


def fake_timeline() -> Timeline:
    """A timeline at rest."""
    return Timeline(FakeOrgan())


def pose_at(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """A pose (4, 4) at a place."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose
