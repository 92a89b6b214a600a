"""What the user does, made into the moments of a session: the transducer led, actions undone, places marked."""

from dataclasses import asdict, dataclass, field

import numpy as np

from rehearsal.adaptive_iterations import AdaptiveIterations
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.replay import set_solver
from rehearsal.sessions.session import Session
from rehearsal.sessions.undo_history import History
from rehearsal.tracking.tracked_probe import Follower, Tracked, TrackOver
from render.viewer import Controls

# A transducer that goes no farther than this in a step rests [mm].
STILL_MM = 1e-3
Ray = tuple[np.ndarray, np.ndarray]


@dataclass
class UserInput:
    """The rehearsal led by the user, a ``Driver``: by a probe that is tracked, else by mouse, keys and gamepad.

    After a way back the transducer stays until the user moves it.
    """

    session: Session
    ladder: AdaptiveIterations
    recorded: SessionRecorder | None = None
    waits: bool = False
    tracked: Tracked | None = None
    _ray: Ray | None = field(default=None, init=False)
    _left: Ray | None = field(default=None, init=False)
    _said: str = field(default="", init=False)
    _asked: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.history = History(self.session)
        self._follower = None if self.tracked is None else Follower(self.tracked, self.session.rehearsal)
        if self.waits:
            self._wait(None)

    @property
    def status(self) -> str:
        """What stands in the panel: that the tracker sees no probe, or which iterations give way."""
        if self._follower is not None and self._follower.is_lost:
            return "TRACKING LOST"
        return self.ladder.says(self._asked)

    @property
    def is_by_hand(self) -> bool:
        """Whether mouse, keys and gamepad lead, and no tracked probe."""
        return self._follower is None

    @property
    def bookmarks(self) -> int:
        """How many the user has set."""
        return len(self.history.bookmarks)

    def move(self, controls: Controls) -> np.ndarray | None:
        """The pose to step to, None where this moment goes back to another."""
        self.session.tell("settings", asdict(controls.settings))
        if self._go_back(controls):
            self._wait(controls.ray)
            return None
        if controls.take_over:
            self._take_over()
        self._set_solver(controls)
        rehearsal = self.session.rehearsal
        held, follower = rehearsal.manipulator.state, self._follower
        pose = self._led(controls) if follower is None else self._followed(follower, controls)
        moves = bool(np.abs(pose - rehearsal.pose).max() > STILL_MM)
        presses = controls.press and follower is None
        # What is kept here is gone back to: with the hand as it was before this input.
        rehearsal.manipulator.state, grip = held, rehearsal.manipulator.state
        self.history.watch(moves or presses, presses)
        rehearsal.manipulator.state = grip
        return pose

    def _take_over(self) -> None:
        """The user leads, and no longer a tracked probe."""
        if self._follower is None:
            self._said = "Yours already"
            return
        self._follower, self._said = None, "Yours now"
        self.session.rehearsal.manipulator.match(self.session.rehearsal.pose)

    def _wait(self, ray: Ray | None) -> None:
        """The transducer stays until the user moves it."""
        self.waits, self._ray = True, ray
        if self._follower is not None:
            self._follower.wait()

    def _followed(self, follower: Follower, controls: Controls) -> np.ndarray:
        """The next pose on the way to where the probe is tracked."""
        rehearsal = self.session.rehearsal
        try:
            goal = follower.goal()
        except TrackOver as over:
            self._follower, self._said = None, str(over)
            self._wait(controls.ray)
            return rehearsal.pose
        pose = rehearsal.pose if goal is None else rehearsal.pose_towards(goal)
        rehearsal.manipulator.match(pose)
        return pose

    def _led(self, controls: Controls) -> np.ndarray:
        """The next pose as mouse, keys and gamepad have it."""
        if self.waits and self._ray is None:
            self._ray = controls.ray
        self.waits = self.waits and not acts(controls, self._ray)
        return self.session.rehearsal.pose if self.waits else self._steered(controls)

    def _go_back(self, controls: Controls) -> bool:
        """Undo, redo, reset or a bookmark, where one of these was asked for and there is something to go to."""
        if controls.bookmark:
            self._said = f"Bookmark {self.history.set_bookmark()}"
        if controls.reset:
            self.history.reset()
            return True
        if controls.undo:
            return self._tried(self.history.undo(), "undo")
        if controls.redo:
            return self._tried(self.history.redo(), "redo")
        if controls.to_bookmark:
            number = self.history.to_bookmark()
            self._said = f"Bookmark {number}" if number else "No bookmark: {bookmark} sets one"
            return number > 0
        return False

    def _tried(self, done: bool, what: str) -> bool:
        self._said = what if done else f"Nothing to {what}"
        return done

    def take_said(self) -> str:
        """What there was to say since this was last asked."""
        said, self._said = self._said, ""
        return said

    def _set_solver(self, controls: Controls) -> None:
        asked = controls.settings
        self._asked = asked.iterations
        values = dict(
            iterations=self.ladder.iterations(asked.iterations),
            substeps=asked.substeps,
            stiffness=asked.stiffness,
            young_kpa=asked.young_kpa,
            gravity_m_s2=asked.gravity_m_s2,
        )
        given = {name: value for name, value in values.items() if value is not None}
        self.session.tell("solver", given)
        set_solver(self.session.rehearsal, given)

    def _steered(self, controls: Controls) -> np.ndarray:
        """Hand the user's input to the hand that holds the transducer; the pose to go to then."""
        rehearsal = self.session.rehearsal
        manipulator = rehearsal.manipulator
        if any(controls.slide_mm):
            manipulator.slide(*controls.slide_mm)
            self._left = controls.ray
        elif controls.ray is not None and mouse_moved(controls.ray, self._left):
            manipulator.point(*controls.ray)
            self._left = None
        manipulator.press(controls.press, rehearsal.settings.time_step_s, controls.press_share)
        manipulator.push(controls.push_mm)
        manipulator.turn(controls.tilt_deg, controls.rock_deg, controls.rotate_deg)
        return rehearsal.pose_towards(manipulator.pose())

    def stepped(self, step_ms: float) -> str:
        """The rehearsal has just advanced to the pose of a move, in so many ms; what the terminal has to say of it."""
        self.session.stepped()
        before = self.status
        if self.ladder.watch(step_ms) and self.status != before:
            return self.status or f"Back to all {self._asked} iterations."
        return ""

    def watch(self) -> str:
        """After each moment: let the session's file keep up; what the terminal has to say of it."""
        return self.recorded.watch() if self.recorded is not None else ""


def acts(controls: Controls, ray: Ray | None) -> bool:
    """Whether the user does anything but keep the mouse on a ray."""
    turns = controls.push_mm, controls.tilt_deg, controls.rock_deg, controls.rotate_deg
    return mouse_moved(controls.ray, ray) or controls.press or any(turns) or any(controls.slide_mm)


def mouse_moved(ray: Ray | None, before: Ray | None) -> bool:
    """Whether the mouse is on a ray, and on another than before."""
    if ray is None or before is None:
        return ray is not None
    return not all(np.array_equal(a, b) for a, b in zip(ray, before, strict=True))
