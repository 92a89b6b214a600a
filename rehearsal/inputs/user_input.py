"""The user's input: mouse, keys and gamepad, or a tracked probe, move the transducer; undo, redo, reset and bookmarks."""

from dataclasses import asdict, dataclass, field

import numpy as np

from rehearsal.adaptive_iterations import AdaptiveIterations
from rehearsal.notices import Notices
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.replay import set_solver
from rehearsal.sessions.session import History, Session
from rehearsal.tracking.tracked_probe import PoseSource, TrackEnded, TrackingInput
from render.viewer import Controls, TissueSettings

# A transducer that moves by no more than this in a step is at rest [mm].
STILL_MM = 1e-3
Ray = tuple[np.ndarray, np.ndarray]


@dataclass
class UserInput:
    """An ``InputSource``: the user moves the transducer by mouse, keys and gamepad, or by a tracked probe if there is one.

    After undo, redo, reset or a bookmark the transducer stays (``waits``) until the user moves it.
    """

    session: Session
    adaptive_iterations: AdaptiveIterations
    recorder: SessionRecorder | None = None
    waits: bool = False
    tracked: PoseSource | None = None
    notices: Notices = field(default_factory=Notices)
    _ray: Ray | None = field(default=None, init=False)
    _ray_at_slide: Ray | None = field(default=None, init=False)
    _iterations_set: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.history = History(self.session)
        self._follower = None if self.tracked is None else TrackingInput(self.tracked, self.session.rehearsal)
        if self.waits:
            self._wait(None)

    @property
    def status(self) -> str:
        """The text in the panel: the tracker has lost the probe, or the iterations are reduced."""
        if self._follower is not None and self._follower.is_lost:
            return "TRACKING LOST"
        return self.adaptive_iterations.status(self._iterations_set)

    @property
    def is_manual(self) -> bool:
        """Whether mouse, keys and gamepad move the transducer, and no tracked probe."""
        return self._follower is None

    @property
    def bookmarks(self) -> int:
        """Number of bookmarks that the user has set."""
        return len(self.history.bookmarks)

    def next_pose(self, controls: Controls) -> np.ndarray | None:
        """Return the pose (4, 4) to step to, or None where the state was restored to an earlier one."""
        self.session.note_changes("settings", asdict(controls.settings))
        if self._restore_earlier(controls):
            self._wait(controls.ray)
            return None
        if controls.take_over:
            self._take_over()
        self._set_solver(controls.settings)
        rehearsal, follower = self.session.rehearsal, self._follower
        before = rehearsal.manipulator.state
        pose = self._manual_pose(controls) if follower is None else self._tracked_pose(follower, controls)
        moves = bool(np.abs(pose - rehearsal.pose).max() > STILL_MM)
        presses = controls.press and follower is None
        self.history.watch(moves or presses, presses, before)
        return pose

    def after_step(self, step_ms: float) -> None:
        """Note the step that the rehearsal has just made, and its duration [ms]."""
        self.session.end_step()
        before = self.status
        if self.adaptive_iterations.watch(step_ms) and self.status != before:
            text = self.status or f"All {self._iterations_set} iterations again."
            self.notices.post(text, on_screen=False)

    def after_frame(self) -> None:
        """Let the session's file keep up."""
        if self.recorder is not None:
            self.recorder.keep_up()

    def _take_over(self) -> None:
        """Mouse, keys and gamepad replace the tracked probe."""
        if self._follower is None:
            self._show("Mouse and keys control the probe already")
            return
        self._follower = None
        self._show("Mouse and keys control the probe")
        self.session.rehearsal.manipulator.match(self.session.rehearsal.pose)

    def _show(self, text: str) -> None:
        self.notices.post(text, in_terminal=False)

    def _wait(self, ray: Ray | None) -> None:
        """The transducer stays until the user moves it."""
        self.waits, self._ray = True, ray
        if self._follower is not None:
            self._follower.wait()

    def _tracked_pose(self, follower: TrackingInput, controls: Controls) -> np.ndarray:
        """The next pose towards the tracked probe."""
        rehearsal = self.session.rehearsal
        try:
            goal = follower.goal()
        except TrackEnded as over:
            self._follower = None
            self._show(str(over))
            self._wait(controls.ray)
            return rehearsal.pose
        pose = rehearsal.pose if goal is None else rehearsal.pose_towards(goal)
        rehearsal.manipulator.match(pose)
        return pose

    def _manual_pose(self, controls: Controls) -> np.ndarray:
        """The next pose as mouse, keys and gamepad ask for it."""
        if self.waits and self._ray is None:
            self._ray = controls.ray
        self.waits = self.waits and not acts(controls, self._ray)
        if self.waits:
            return self.session.rehearsal.pose
        return self._moved_manipulator(controls)

    def _moved_manipulator(self, controls: Controls) -> np.ndarray:
        rehearsal = self.session.rehearsal
        manipulator, time_s = rehearsal.manipulator, rehearsal.settings.time_step_s
        if any(controls.slide_mm):
            manipulator.slide(*controls.slide_mm)
            self._ray_at_slide = controls.ray
        elif controls.ray is not None and mouse_moved(controls.ray, self._ray_at_slide):
            manipulator.point(*controls.ray)
            self._ray_at_slide = None
        manipulator.press(controls.press, time_s, controls.press_share)
        manipulator.push(controls.push_mm)
        manipulator.turn(controls.tilt_deg, controls.rock_deg, controls.rotate_deg)
        return manipulator.pose_towards(manipulator.pose(), rehearsal.pose, time_s)

    def _restore_earlier(self, controls: Controls) -> bool:
        """Undo, redo, reset or a bookmark; whether the state was restored to an earlier one."""
        if controls.bookmark:
            self._show(f"Bookmark {self.history.set_bookmark()}")
        if controls.reset:
            self.history.reset()
            return True
        if controls.undo:
            return self._shown(self.history.undo(), "undo")
        if controls.redo:
            return self._shown(self.history.redo(), "redo")
        if controls.to_bookmark:
            number = self.history.to_bookmark()
            self._show(f"Bookmark {number}" if number else "No bookmark: {bookmark} sets one")
            return number > 0
        return False

    def _shown(self, done: bool, what: str) -> bool:
        self._show(what if done else f"Nothing to {what}")
        return done

    def _set_solver(self, settings: TissueSettings) -> None:
        self._iterations_set = settings.iterations
        values = dict(
            iterations=self.adaptive_iterations.iterations(settings.iterations),
            substeps=settings.substeps,
            stiffness=settings.stiffness,
            young_kpa=settings.young_kpa,
            gravity_m_s2=settings.gravity_m_s2,
        )
        given = {name: value for name, value in values.items() if value is not None}
        self.session.note_changes("solver", given)
        set_solver(self.session.rehearsal, given)


def acts(controls: Controls, ray: Ray | None) -> bool:
    """Whether the user does anything but keep the mouse on a ray."""
    turns = controls.push_mm, controls.tilt_deg, controls.rock_deg, controls.rotate_deg
    return mouse_moved(controls.ray, ray) or controls.press or any(turns) or any(controls.slide_mm)


def mouse_moved(ray: Ray | None, before: Ray | None) -> bool:
    """Whether the mouse is on a ray, and on another than before."""
    if ray is None or before is None:
        return ray is not None
    return not all(np.array_equal(a, b) for a, b in zip(ray, before, strict=True))
