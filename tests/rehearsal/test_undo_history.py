"""Undo, redo and bookmarks, on a tissue of a few numbers; and what the user's hands make of them."""

import hashlib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from rehearsal.inputs.user_input import UserInput
from rehearsal.sessions.session import MOST_UNDONE, SETTLED, History, Session

from rehearsal.pressed_organ import PressedOrgan, Step
from rehearsal.rehearsal import RehearsalState
from rehearsal.resection.resection_state import NO_RESECTION, Resection
from rehearsal.resection.score_line import ResectionError
from render.viewer import Controls, Settings
from scenes.tissue import NeoHookeanTissue
from sim.body import BodyState
from sim.divergence_check import DivergenceState
from sim.solver import SolverState, StepSettings
from ultrasound.probe_manipulator import ManipulatorState, ProbeManipulator, pose_at, touching

# A power of two, so that times are exact: 4 steps are PAUSE_S, 40 are LONGEST_S.
STEP_S = 1 / 8
DOWN = np.array([0.0, 0.0, -1.0])


class Numbers:
    """A rehearsal whose tissue is two points, moved by all that a step is told; the hand over it, and its ball, are real."""

    origin = np.zeros(3)
    model = SimpleNamespace(serial=True)

    def __init__(self) -> None:
        self.settings = StepSettings(time_step_s=STEP_S)
        self.scene = SimpleNamespace(tissue=NeoHookeanTissue())
        ball = trimesh.creation.icosphere(subdivisions=2, radius=12.0)
        vertices, faces = np.array(ball.vertices), np.array(ball.faces, np.int64)
        size = np.array([16.0, 9.0, 6.0])
        home = touching(pose_at(np.array([0, 0, 12.0]), DOWN, np.eye(3)[0], 6.0), size, vertices)
        self.manipulator = ProbeManipulator(
            vertices, faces, np.array(ball.vertex_normals), size, home, np.eye(3)[0], speed_mm_s=150.0
        )
        self.pose = self.manipulator.pose()
        self.young_kpa, self.steps = 15.0, 0
        self.resection = NO_RESECTION
        self.whole_organ, self.whole_tumour, self.judgement = ball, None, None
        self.scanner, self.judgement_fault = None, ""
        self.position = np.arange(6, dtype=np.float32).reshape(2, 3)
        self.velocity = np.zeros((2, 3), np.float32)
        self.contacts = {"plane": np.zeros((2, 4), np.float32)}
        self.watch = DivergenceState(self._solver())
        self.settled = self.snapshot()

    def _solver(self) -> SolverState:
        return SolverState(BodyState(self.position, self.velocity), self.contacts)

    def snapshot(self, manipulator: ManipulatorState | None = None) -> RehearsalState:
        held = manipulator or self.manipulator.state
        return RehearsalState(self._solver(), self.watch, self.pose, self.steps, held, self.resection)

    @property
    def body(self) -> SimpleNamespace:
        return SimpleNamespace(snapshot=lambda: BodyState(self.position, self.velocity))

    @property
    def cut(self) -> SimpleNamespace | None:
        return None if self.resection.cut is None else SimpleNamespace(warnings=())

    def set_resection(self, resection: Resection) -> None:
        if resection.cut is not None and not resection.marks:
            raise ResectionError("a cut without a score")
        self.resection = resection

    def restore(self, state: RehearsalState) -> None:
        self.position, self.velocity = state.solver.body.position, state.solver.body.velocity
        self.contacts, self.watch = state.solver.history, state.divergence
        self.pose, self.steps, self.manipulator.state = state.pose, state.steps, state.manipulator
        self.resection = state.resection

    def advance(self, pose: np.ndarray) -> None:
        """Each step depends on the settings, the contacts, the divergence check's state, the marks and the cut."""
        moved = 1e-3 * self.young_kpa + 1e-2 * self.settings.iterations + 1e-3 * self.settings.gravity[2]
        cut = self.resection.cut
        moved += 0.1 * len(self.resection.marks) + (0.0 if cut is None else 0.3 + 1e-3 * cut.nodes_mm.sum())
        drawn = self.contacts["plane"][:, :3] + 0.01 * (self.watch.steps_since_good % 7)
        self.velocity = (0.9 * self.velocity + moved + drawn + 0.01 * pose[:3, 3]).astype(np.float32)
        length_s = np.float32(self.settings.time_step_s)
        self.position = (0.99 * self.position + length_s * self.velocity).astype(np.float32)
        self.contacts = {"plane": np.sin(np.pad(self.position, ((0, 0), (0, 1))))}
        since = self.watch.steps_since_good + 1
        self.watch = (
            DivergenceState(self._solver()) if since > 11 else replace(self.watch, steps_since_good=since)
        )
        self.pose = pose
        self.steps += 1

    step_of = PressedOrgan.step_of

    def timed_step(
        self, pose: np.ndarray, length_s: float | None = None, iterations: int | None = None
    ) -> Step:
        with self.step_of(length_s or self.settings.time_step_s, iterations or self.settings.iterations):
            self.advance(pose)
            return Step(pose, self.settings.time_step_s, self.settings.iterations, 0.0)

    def store_valid_state(self) -> None:
        self.watch = DivergenceState(self._solver())

    def pose_towards(self, goal: np.ndarray) -> np.ndarray:
        return self.manipulator.pose_towards(goal, self.pose, STEP_S)

    def set_young(self, young_kpa: float) -> None:
        self.young_kpa = young_kpa

    def set_gravity(self, acceleration_m_s2: float) -> None:
        self.settings.gravity = (0.0, 0.0, 1000.0 * acceleration_m_s2)

    def update_surfaces(self) -> None: ...

    def digest(self) -> str:
        return hashlib.sha256(self.position.tobytes() + self.velocity.tobytes()).hexdigest()[:16]


class Told:
    """A recorder that lists what it is told."""

    def __init__(self) -> None:
        self.notes: list[tuple[str, Any]] = []
        self.poses: list[np.ndarray | None] = []

    def note(self, kind: str, value: Any) -> None:
        self.notes.append((kind, value))

    is_state_due = False

    def add_step(self, pose: np.ndarray | None, length_s: float, wrench: np.ndarray | None = None) -> None:
        self.poses.append(pose)

    def of(self, kind: str) -> list[Any]:
        return [value for each, value in self.notes if each == kind]


@pytest.fixture
def history() -> History:
    return History(Session(Numbers(), Told()))


def go(history: History, steps: int = 1, acting: bool = True, pressing: bool = False) -> str:
    """So many steps in which the user acts or rests; the digest after them."""
    for _ in range(steps):
        history.watch(acting, pressing)
        history.session.rehearsal.advance(history.session.rehearsal.pose)
        history.session.end_step()
    return history.session.rehearsal.digest()


def act(history: History) -> str:
    """An action of its own: some steps after a rest."""
    go(history, 5, acting=False)
    return go(history, 3)


def begun(history: History) -> list[int]:
    return sorted(set(history.session.kept_states) - {SETTLED})


def now(history: History) -> str:
    return history.session.rehearsal.digest()


def test_input_after_a_pause_begins_an_action(history):
    go(history, 1)
    go(history, 3, acting=False)
    go(history, 1)  # 0.5 s after the last input: the same action
    assert begun(history) == [0]
    go(history, 4, acting=False)
    go(history, 1)  # 0.625 s
    assert begun(history) == [0, 9]


def test_a_press_begins_an_action_once(history):
    go(history, 3)
    go(history, 4, pressing=True)
    go(history, 2)
    go(history, 2, pressing=True)
    assert begun(history) == [0, 3, 9]


def test_an_action_lasts_five_seconds_at_most(history):
    go(history, 41)
    assert begun(history) == [0]
    go(history, 41)
    assert begun(history) == [0, 41]


def test_undo_goes_before_the_last_action_and_redo_back(history):
    states = [now(history), act(history), act(history)]
    before = go(history, 5, acting=False)
    last = go(history, 3)
    assert history.undo() and now(history) == before
    assert history.undo() and history.undo() and not history.undo()
    assert history.redo() and history.redo() and history.redo() and not history.redo()
    assert now(history) == last and len(set(states)) == 3


def test_time_goes_on_with_every_way_back(history):
    act(history)
    history.undo()
    history.redo()
    history.redo()
    assert history.session.step_index == 10 and history.session.time_s == 10 * STEP_S
    told = history.session.recorder
    assert [pose is None for pose in told.poses] == [False] * 8 + [True] * 2
    assert told.of("back") == [5, 8]


def test_a_new_action_after_an_undo_clears_redo_and_can_be_undone_itself(history):
    act(history)
    history.undo()
    before = now(history)
    go(history, 1)  # at once: an undo ends the action
    assert not history.redo()
    assert history.undo() and now(history) == before


def test_forty_actions_can_be_undone_and_no_more(history):
    states = []
    for _ in range(MOST_UNDONE + 3):
        states.append(go(history, 5, acting=False))
        go(history, 2)
    assert MOST_UNDONE == 40 and len(history.session.kept_states) == 41
    for before in states[:2:-1]:
        assert history.undo() and now(history) == before
    assert not history.undo()
    assert all(history.redo() for _ in range(40)) and not history.redo()


def test_a_reset_can_be_undone(history):
    settled = now(history)
    pressed = act(history)
    history.reset()
    assert now(history) == settled != pressed
    assert history.undo() and now(history) == pressed


def test_bookmarks_are_gone_to_last_first_then_round(history):
    assert history.to_bookmark() == 0 and history.session.step_index == 0
    marked = []
    for number in (1, 2, 3):
        marked.append(act(history))
        assert history.set_bookmark() == number
    left = act(history)
    for number in (3, 2, 1, 3):
        assert history.to_bookmark() == number and now(history) == marked[number - 1]
    for expected in (marked[0], marked[1], marked[2], left):
        assert history.undo() and now(history) == expected
    history.set_bookmark()
    assert history.to_bookmark() == 4
    assert history.session.recorder.of("bookmark") == [1, 2, 3, 4]


def test_a_bookmark_outlives_the_undo_states(history):
    marked = act(history)
    history.set_bookmark()
    for _ in range(MOST_UNDONE + 5):
        act(history)
    assert len(history.session.kept_states) == 1 + 1 + MOST_UNDONE
    assert history.to_bookmark() == 1 and now(history) == marked


def test_undo_and_redo_in_turn_keep_no_more_and_more(history):
    for _ in range(3):
        act(history)
    for _ in range(50):
        history.undo()
        history.undo()
        history.redo()
        history.redo()
    # The settled state, three to be undone, and the two that were redone last at most.
    assert len(history.session.kept_states) <= 6


def live_of(told: Told | None = None) -> UserInput:
    return UserInput(Session(Numbers(), told))


def step(
    live: UserInput, length_s: float | None = None, iterations: int | None = None, pace: str = "", **did: Any
) -> np.ndarray | None:
    """A moment in which the user did something, with a step of its own length and iterations."""
    settings = did.pop("settings", None) or Settings(young_kpa=15.0)
    pose = live.next_pose(Controls(settings, **did))
    if pose is not None:
        made = live.session.rehearsal.timed_step(pose, length_s, iterations)
        live.after_step(replace(made, pace=pace))
    return pose


def shown(live: UserInput) -> str:
    """The notices since the last call."""
    return "".join(live.notices.present())


def ray(x_mm: float) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x_mm, 0.0, 60.0]), DOWN


def pressed_then_undone(at: Any) -> UserInput:
    """The mouse went to x = 5 mm, pressed there, and the press was undone."""
    live = live_of()
    for _ in range(8):
        step(live, ray=ray(5.0))
    for _ in range(5):
        step(live, ray=ray(5.0), press=True)
    assert step(live, ray=at, undo=True) is None and shown(live) == "undo"
    return live


DID = [
    dict(ray=ray(2.0)),
    dict(press=True),
    *({name: 0.5} for name in ("push_mm", "tilt_deg", "rock_deg", "rotate_deg")),
    dict(slide_mm=(0.0, 0.5)),
]


@pytest.mark.parametrize("did", DID, ids=lambda did: next(iter(did)))
def test_after_an_undo_the_transducer_stays_until_the_user_acts(did):
    live = pressed_then_undone(ray(3.0))
    undone = live.session.rehearsal.pose
    for _ in range(10):
        assert np.array_equal(step(live, ray=ray(3.0)), undone)
    assert not np.array_equal(step(live, **{"ray": ray(3.0)} | did), undone)
    assert not live.waits
    step(live, ray=ray(-4.0))
    assert not np.array_equal(step(live, ray=ray(-4.0)), undone)


def test_a_mouse_that_comes_back_into_the_view_is_no_act():
    live = pressed_then_undone(None)
    undone = live.session.rehearsal.pose
    step(live)
    assert np.array_equal(step(live, ray=ray(3.0)), undone)
    assert np.array_equal(step(live), undone)
    assert not np.array_equal(step(live, ray=ray(3.5)), undone)


def test_a_way_back_gives_the_hand_as_it_was_before_the_input():
    live = live_of()
    for _ in range(8):
        step(live, ray=ray(5.0))
    manipulator = live.session.rehearsal.manipulator
    before, pose = manipulator.state, live.session.rehearsal.pose
    step(live, ray=ray(-5.0), tilt_deg=7.0, push_mm=0.5, press=True)
    assert manipulator.state.turn_deg == (7.0, 0.0, 0.0)
    step(live, undo=True)
    grip = manipulator.state
    assert (grip.depth_mm, grip.pressed_mm, grip.turn_deg) == (0.0, 0.0, (0.0, 0.0, 0.0))
    assert np.array_equal(grip.aim, before.aim)
    assert np.array_equal(live.session.rehearsal.pose, pose)


def test_the_iterations_that_were_done_are_recorded_not_those_asked_for():
    told = Told()
    live = live_of(told)
    step(live, settings=Settings(young_kpa=15.0, iterations=10), iterations=5)
    assert {"iterations": 5} in told.of("solver") and told.of("settings")[0]["iterations"] == 10
    step(live, settings=Settings(young_kpa=15.0, iterations=10), iterations=3)
    assert told.of("solver")[-1] == {"iterations": 3} and len(told.of("settings")) == 1
    assert live.session.rehearsal.settings.iterations == 10


def test_a_pace_that_differs_is_said_once(capsys):
    live = live_of()
    for pace in ("", "LONGER STEPS   1/30 s", "LONGER STEPS   1/15 s", ""):
        step(live, pace=pace)
        assert live.status == pace and live.notices.present() == []
    assert capsys.readouterr().out == "LONGER STEPS   1/30 s\nSteps as they are set again.\n"


def test_only_what_changes_is_told():
    told = Told()
    live = live_of(told)
    settings = Settings(young_kpa=15.0)
    for young_kpa, gain in ((15.0, 50), (15.0, 50), (30.0, 50), (30.0, 70)):
        settings.young_kpa, settings.gain_percent = young_kpa, gain
        step(live, settings=settings)
    assert told.of("solver")[2:] == [{"young_kpa": 30.0}]
    assert told.of("settings")[1:] == [{"young_kpa": 30.0}, {"gain_percent": 70}]
    assert live.session.rehearsal.young_kpa == 30.0


def test_a_way_back_to_nowhere_is_said_and_no_moment_is_lost():
    live, said = live_of(), []
    for key in ("undo", "redo", "to_bookmark", "bookmark", "to_bookmark"):
        step(live, **{key: True})
        said.append(shown(live))
    nothing = ["Nothing to undo", "Nothing to redo", "No bookmark: {bookmark} sets one"]
    assert said == [*nothing, "Bookmark 1", "Bookmark 1"] and shown(live) == ""
    assert live.session.step_index == 5 and live.session.rehearsal.steps == 3


def face(live: UserInput) -> np.ndarray:
    """Where the hand aims."""
    return (live.session.rehearsal.manipulator.aim @ [0, 0, -3.0, 1])[:3]


def test_after_a_slide_the_mouse_leads_only_once_it_moves():
    live = live_of()
    for _ in range(4):
        step(live, ray=ray(2.0))
    for _ in range(10):
        step(live, ray=ray(2.0), slide_mm=(-0.5, 0.2))
    # On the ball of 12 mm 5.4 mm of way, of which some is height.
    slid = face(live)
    assert slid[0] == pytest.approx(-3.0, abs=0.4) and slid[1] == pytest.approx(2.0, abs=0.3)
    step(live, ray=ray(2.0))
    assert np.array_equal(face(live), slid)
    step(live, ray=ray(2.5))
    assert face(live)[:2] == pytest.approx([2.5, 0.0])
    step(live, ray=ray(2.0))
    assert face(live)[:2] == pytest.approx([2.0, 0.0])


def test_a_press_by_a_share_goes_no_deeper():
    live = live_of()
    for _ in range(30):
        step(live, press=True, press_share=0.5)
    manipulator = live.session.rehearsal.manipulator
    assert manipulator.state.pressed_mm == pytest.approx(manipulator.max_mm / 2)
