"""The user: mouse, keys and gamepad, or a tracked probe, move the transducer; settings, undo, bookmarks,
and the operation.
"""

from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any

import numpy as np

from errors import UserError
from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.live_settings import LiveSettings
from rehearsal.loop.command import (
    BeginAction,
    Bookmark,
    Command,
    Follow,
    GoTo,
    Mark,
    Pause,
    Redo,
    Reset,
    SetValues,
    Undo,
)
from rehearsal.loop.frame import Applied, Frame, Refused
from rehearsal.notices import Notices
from rehearsal.resection.operation import IsSeen, cut_command, mark_under, marks_of_image, places_at_rest
from rehearsal.resection.resection_plan import ResectionPlan
from rehearsal.resection.resection_state import ResectionScript, ScriptedAction
from rehearsal.resection.resection_view import cut_settings
from rehearsal.resection.score_line import ResectionError
from rehearsal.sources.tracker import TrackEnded, Tracker
from render.viewer import Controls
from settings import live_values
from ultrasound.probe_manipulator import ManipulatorState, ProbeManipulator

# A transducer that moves by no more than this between two frames is at rest [mm].
STILL_MM = 1e-3
# The mouse has moved on from where keys pushed the transducer in when it aims further away than this.
MOVED_ON_MM = 3.0
# Input that follows the last one sooner than this belongs to the same action; an action lasts no longer than
# that.
PAUSE_S, LONGEST_S = 0.5, 5.0

Ray = tuple[np.ndarray, np.ndarray]


class UserSource:
    """A ``Source``: the user moves the transducer by ``hand``, or by a tracked probe if there is one.

    After undo, redo, reset or a bookmark the transducer stays until the user moves it. ``is_seen`` says which
    points the images have shown; without it all count as seen.
    """

    def __init__(
        self,
        anatomy: DeformedAnatomy,
        manipulator: ProbeManipulator,
        notices: Notices,
        tracker: Tracker | None = None,
        script: ResectionScript | None = None,
        resection_plan: ResectionPlan | None = None,
        is_seen: IsSeen | None = None,
        waits: bool = False,
    ) -> None:
        self.anatomy, self.notices, self.tracker = anatomy, notices, tracker
        self.hand = Hand(manipulator, waits)
        if waits and tracker is not None:
            tracker.wait()
        self._script, self._plan, self._is_seen = script, resection_plan, is_seen
        # The pose that the hand asked for last.
        self._goal = anatomy.pose
        self._settings: LiveSettings | None = None
        self._actions = ActionTimes()
        # What restores a state, until it was applied: a pose that was asked for before would undo it.
        self._awaited: Command | None = None
        self._next_bookmark = 0

    @property
    def status(self) -> str:
        """As ``Source.status``: the tracker has lost the probe."""
        return "TRACKING LOST" if self.tracker is not None and self.tracker.is_lost else ""

    @property
    def is_manual(self) -> bool:
        """Whether mouse, keys and gamepad move the transducer, and no tracked probe."""
        return self.tracker is None

    def commands(self, frame: Frame, controls: Controls[LiveSettings], elapsed_s: float) -> Iterator[Command]:
        """As ``Source.commands``."""
        self._see(frame, controls)
        if controls.frozen:
            yield Pause()
            return
        yield from self._changed_settings(controls)
        if self._awaited is None:
            self._awaited = self._restores(frame, controls)
            if self._awaited is not None:
                yield self._awaited
        if self._awaited is not None:
            return
        yield from self._operates(frame, controls)
        if controls.take_over:
            self._take_over()
        before = self.hand.manipulator.state
        pose = self._pose(frame, controls, elapsed_s)
        moves = bool(np.abs(pose - self._goal).max() > STILL_MM)
        presses = controls.press and self.is_manual
        self._goal = pose
        if self._actions.begins(frame.time_s, moves or presses, presses):
            self._next_bookmark = 0
            yield BeginAction(manipulator=before)
        yield Follow(
            pose=pose,
            input_s=perf_counter(),
            took_s=elapsed_s,
            presses=not self.is_manual or self.hand.manipulator.state.presses,
            manipulator=self.hand.manipulator.state,
        )

    def _see(self, frame: Frame, controls: Controls[LiveSettings]) -> None:
        """Take notice of what was done."""
        done = [event.command for event in frame.events if isinstance(event, Applied | Refused)]
        if self._awaited in done:
            self._awaited = None
        if frame.restored:
            self._stay(frame, controls)

    def _stay(self, frame: Frame, controls: Controls[LiveSettings]) -> None:
        """The transducer is where a restored state has it, and stays until the user moves it."""
        self._goal = frame.pose
        if frame.manipulator is None:
            self.hand.manipulator.state = ManipulatorState()
        else:
            self.hand.manipulator.state = frame.manipulator
        self._actions.end()
        self.hand.wait(controls.ray)
        if self.tracker is not None:
            self.tracker.wait()

    def _changed_settings(self, controls: Controls[LiveSettings]) -> Iterator[Command]:
        if controls.settings is self._settings:
            return
        before = {} if self._settings is None else live_values(self._settings)
        self._settings, values = controls.settings, live_values(controls.settings)
        changed = {path: value for path, value in values.items() if before.get(path) != value}
        if changed:
            yield SetValues(values=changed)

    def _restores(self, frame: Frame, controls: Controls[LiveSettings]) -> Command | None:
        """Undo, redo, reset, the next attempt, or the last bookmark, the one before it when asked again."""
        if controls.bookmark:
            self._next_bookmark = 0
            return Bookmark()
        if controls.reset:
            return Reset()
        if controls.undo:
            return Undo()
        if controls.redo:
            return Redo()
        if controls.to_bookmark and not frame.bookmarks:
            self._say("No bookmark: {bookmark} sets one")
        elif controls.to_bookmark:
            self._next_bookmark = (self._next_bookmark - 1) % len(frame.bookmarks)
            self._say(f"Bookmark {self._next_bookmark + 1}")
            return GoTo(state=frame.bookmarks[self._next_bookmark])
        return self._next_attempt(frame) if controls.next_attempt else None

    def _next_attempt(self, frame: Frame) -> Command | None:
        """To the attempt after the present one, the first after the last; without a cut, to the last."""
        if not frame.attempts:
            self._say("No attempt yet: {cut_out} cuts along the score")
            return None
        present = frame.present_attempt
        attempt = frame.attempts[-1 if present is None else present.number % len(frame.attempts)]
        self._say(f"Attempt {attempt.number} of {len(frame.attempts)}")
        return GoTo(state=attempt.state)

    def _operates(self, frame: Frame, controls: Controls[LiveSettings]) -> Iterator[Command]:
        """Marks of the score, or a cut, as the user or the script asks for it; say what cannot be done."""
        margin_mm = controls.settings.plan.margin_mm
        if controls.score_under is not None:
            origin, direction = controls.score_under
            yield from self._marks(lambda: mark_under(self.anatomy, origin, direction))
        elif controls.score_image:
            yield from self._marks(lambda: marks_of_image(self.anatomy, margin_mm))
        elif controls.score_planned:
            yield from self._marks(self._planned_marks, replaces=True)
        elif controls.cut_out:
            yield self._cut(cut_settings(controls.settings))
        elif self._script is not None and self._script.is_due(frame.time_s):
            yield from self._scripted(self._script.next())

    def _marks(self, places: Callable[[], np.ndarray], replaces: bool = False) -> Iterator[Command]:
        try:
            yield Mark(places_mm=places().tolist(), replaces=replaces)
        except UserError as error:
            self.notices.post(str(error))

    def _cut(self, settings: Any) -> Command:
        # Without a CT there are no images that could have shown the tumour.
        return cut_command(
            self.anatomy, settings, self._is_seen if self.anatomy.scanner is not None else None
        )

    def _scripted(self, action: ScriptedAction) -> Iterator[Command]:
        if action.score == "image":
            yield from self._marks(lambda: marks_of_image(self.anatomy, action.margin_mm))
        elif action.score is not None:
            places = np.array(action.score, float)
            yield from self._marks(lambda: places_at_rest(self.anatomy.case, places))
        if action.cut is not None:
            yield self._cut(action.cut)

    def _planned_marks(self) -> np.ndarray:
        """Raises ResectionError without a plan."""
        if self._plan is None:
            raise ResectionError(
                "no planned line; make a plan with app.py plan --resect, and open it with --plan"
            )
        planned = self._plan.best
        self.notices.post(
            f"Planned line: for {planned.technique} with a margin of {self._plan.margin_mm:g} mm; "
            f"{{technique}} chooses the technique"
        )
        return places_at_rest(self.anatomy.case, np.array(planned.marks_mm))

    def _pose(self, frame: Frame, controls: Controls[LiveSettings], elapsed_s: float) -> np.ndarray:
        """The pose that the hand or the tracked probe asks for."""
        if self.tracker is None:
            return self.hand.pose(controls, self._goal, elapsed_s)
        try:
            goal = self.tracker.goal(frame.time_s)
        except TrackEnded as over:
            self.tracker = None
            self._say(str(over))
            self.hand.wait(controls.ray)
            return self._goal
        manipulator = self.hand.manipulator
        pose = self._goal if goal is None else manipulator.pose_towards(goal, self._goal, elapsed_s)
        manipulator.match(pose)
        return pose

    def _take_over(self) -> None:
        """Mouse, keys and gamepad replace the tracked probe."""
        if self.tracker is None:
            self._say("Mouse and keys control the probe already")
            return
        self.tracker = None
        self._say("Mouse and keys control the probe")
        self.hand.manipulator.match(self._goal)

    def _say(self, text: str) -> None:
        self.notices.post(text, in_terminal=False)


class Hand:
    """What mouse, keys and gamepad ask of the manipulator.

    ``waits``: the transducer stays until the user moves it.
    """

    def __init__(self, manipulator: ProbeManipulator, waits: bool = False) -> None:
        self.manipulator, self.waits = manipulator, waits
        self._ray: Ray | None = None
        self._ray_at_slide: Ray | None = None
        self._pushed_at_mm: np.ndarray | None = None

    def wait(self, ray: Ray | None) -> None:
        """Stay until the mouse leaves a ray, or a key is pressed."""
        self.waits, self._ray = True, ray
        self._pushed_at_mm = self.manipulator.aim[:3, 3]

    def pose(self, controls: Controls, pose: np.ndarray, time_s: float) -> np.ndarray:
        """The transducer's next pose (4, 4) after the last one, a time [s] later."""
        if self.waits and self._ray is None:
            self._ray = controls.ray
        self.waits = self.waits and not acts(controls, self._ray)
        if self.waits:
            return pose
        manipulator = self.manipulator
        if any(controls.slide_mm):
            manipulator.slide(*controls.slide_mm)
            self._ray_at_slide = controls.ray
        elif controls.ray is not None and mouse_moved(controls.ray, self._ray_at_slide):
            manipulator.point(*controls.ray)
            self._ray_at_slide = None
        manipulator.press(controls.press, time_s, controls.press_share)
        self._push(controls, time_s)
        manipulator.turn(controls.tilt_deg, controls.rock_deg, controls.rotate_deg)
        return manipulator.pose_towards(manipulator.pose(), pose, time_s)

    def _push(self, controls: Controls, time_s: float) -> None:
        """Push by the keys; the depth goes back when the mouse has moved on."""
        manipulator = self.manipulator
        aim_mm = manipulator.aim[:3, 3]
        if controls.push_mm or any(controls.slide_mm):
            self._pushed_at_mm = aim_mm
            manipulator.push(controls.push_mm)
        elif (at_mm := self._pushed_at_mm) is not None and np.linalg.norm(aim_mm - at_mm) > MOVED_ON_MM:
            manipulator.go_back(time_s)


def acts(controls: Controls, ray: Ray | None) -> bool:
    """Whether the user does anything but keep the mouse on a ray."""
    turns = controls.push_mm, controls.tilt_deg, controls.rock_deg, controls.rotate_deg
    return mouse_moved(controls.ray, ray) or controls.press or any(turns) or any(controls.slide_mm)


def mouse_moved(ray: Ray | None, before: Ray | None) -> bool:
    """Whether the mouse is on a ray, and on another than before."""
    if ray is None or before is None:
        return ray is not None
    return not all(np.array_equal(a, b) for a, b in zip(ray, before, strict=True))


class ActionTimes:
    """When an action of the user begins: a press, a turn, a path over the organ, without a pause."""

    def __init__(self) -> None:
        self._began_s = self._acted_s = -LONGEST_S
        self._was_pressing = False

    def begins(self, now_s: float, acts: bool, presses: bool) -> bool:
        """Whether an action begins now."""
        begins_press, self._was_pressing = presses and not self._was_pressing, presses
        if not acts:
            return False
        begins = begins_press or now_s - self._acted_s > PAUSE_S or now_s - self._began_s > LONGEST_S
        self._acted_s = now_s
        if begins:
            self._began_s = now_s
        return begins

    def end(self) -> None:
        """What follows is another action."""
        self._acted_s = -LONGEST_S
