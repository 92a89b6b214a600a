"""The user's input: mouse, keys and gamepad, or a tracked probe, move the transducer; undo, redo, reset and bookmarks."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from time import perf_counter
from typing import Any

import numpy as np

from errors import UserError
from rehearsal.notices import Notices
from rehearsal.pressed_organ import Step
from rehearsal.real_time.solver_process import SolverProcess
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.operation import (
    LEAST_SEEN,
    cut,
    mark_under,
    marks_of_image,
    places_at_rest,
    seen_share,
    set_marks,
)
from rehearsal.resection.resection_plan import ResectionPlan
from rehearsal.resection.resection_view import cut_settings
from rehearsal.resection.score_line import ResectionError
from rehearsal.resection.script import ResectionScript, ScriptedAction
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.replay import set_solver
from rehearsal.sessions.session import History, Session
from rehearsal.tracking.tracked_probe import PoseSource, TrackEnded, TrackingInput
from render.viewer import Controls, TissueSettings

# A transducer that moves by no more than this in a step is at rest [mm].
STILL_MM = 1e-3
Ray = tuple[np.ndarray, np.ndarray]
# Controls that restore states or act on the organ, and their values when nobody uses them.
AFTER_ACTION = (
    *("reset", "undo", "redo", "bookmark", "to_bookmark"),
    *("score_image", "score_under", "score_planned", "cut_out"),
)
UNSEEN = (
    "tumour surface seen {:.0f} %: the cut keeps no margin from the rest, however much of the volume was seen"
)
NOTHING = {each.name: each.default for each in fields(Controls) if each.name in AFTER_ACTION}


@dataclass
class UserInput:
    """An ``InputSource``: the user moves the transducer by mouse, keys and gamepad, or by a tracked probe if there is one.

    After undo, redo, reset or a bookmark the transducer stays (``waits``) until the user moves it.
    """

    session: Session
    recorder: SessionRecorder | None = None
    waits: bool = False
    tracked: PoseSource | None = None
    script: ResectionScript | None = None
    notices: Notices = field(default_factory=Notices)
    resection_plan: ResectionPlan | None = None
    _ray: Ray | None = field(default=None, init=False)
    _ray_at_slide: Ray | None = field(default=None, init=False)
    _pace: str = field(default="", init=False)
    _solver_values: dict[str, Any] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        # The pose that was asked for last; the transducer follows it.
        self._goal = self.session.rehearsal.pose
        self.history = History(self.session)
        # The index at which a mark was set or a cut made last, and controls that wait for the step after it.
        self._acted_at = -1
        self._waiting: dict[str, Any] = {}
        self._follower = None if self.tracked is None else TrackingInput(self.tracked, self.session.rehearsal)
        if self.waits:
            self._wait(None)

    @property
    def status(self) -> str:
        """The text in the panel: the tracker has lost the probe, or the steps are not as they are set."""
        if self._follower is not None and self._follower.is_lost:
            return "TRACKING LOST"
        return self._pace

    @property
    def is_manual(self) -> bool:
        """Whether mouse, keys and gamepad move the transducer, and no tracked probe."""
        return self._follower is None

    @property
    def bookmarks(self) -> int:
        """Number of bookmarks that the user has set."""
        return len(self.history.bookmarks)

    def drive(self, solver: SolverProcess, controls: Controls, elapsed_s: float) -> None:
        """Give the solver the user's input after a time [s]; pause it for what changes more than the transducer's pose."""
        input_s = perf_counter()
        controls = self._due(controls)
        if self._interrupts(controls):
            solver.pause()
            self.after_frame()
        pose = self.next_pose(controls, elapsed_s)
        if solver.is_paused:
            solver.hand_over()
            solver.run()
        if pose is not None:
            solver.go_to(pose, input_s, elapsed_s)

    def _interrupts(self, controls: Controls) -> bool:
        """Whether the controls change more than the pose, or the whole state is to be recorded."""
        restores = (controls.reset, controls.undo, controls.redo, controls.bookmark, controls.to_bookmark)
        if controls.operates or (self.script is not None and self.script.is_due(self.session.time_s)):
            return True
        changes = solver_values(controls.settings) != self._solver_values
        return any(restores) or changes or (self.recorder is not None and self.recorder.is_state_due)

    def next_pose(self, controls: Controls, elapsed_s: float | None = None) -> np.ndarray | None:
        """Return the pose (4, 4) to step to, or None where the state was restored to an earlier one.

        ``elapsed_s`` is the time since the last input, if not one step.
        """
        controls = self._due(controls)
        self.session.note_changes("settings", asdict(controls.settings))
        rehearsal, follower = self.session.rehearsal, self._follower
        if self._restore_earlier(controls):
            self._wait(controls.ray)
            self._goal = rehearsal.pose
            return None
        self._operate(controls)
        if controls.take_over:
            self._take_over()
            follower = None
        self._set_solver(controls.settings)
        time_s = rehearsal.settings.time_step_s if elapsed_s is None else elapsed_s
        before = rehearsal.manipulator.state
        if follower is None:
            pose = self._manual_pose(controls, time_s)
        else:
            pose = self._tracked_pose(follower, controls, time_s)
        moves = bool(np.abs(pose - self._goal).max() > STILL_MM)
        presses = controls.press and follower is None
        if self.session.step_index != self._acted_at:
            self.history.watch(moves or presses, presses, before)
        self._goal = pose
        return pose

    def after_step(self, step: Step) -> None:
        """Note a step that was made."""
        self.session.note_changes("solver", dict(iterations=step.iterations))
        self.session.end_step(step.pose, step.length_s, step.wrench)
        # In the terminal once, not for each length: the panel shows the present one.
        if bool(step.pace) != bool(self._pace):
            self.notices.post(step.pace or "Steps as they are set again.", on_screen=False)
        self._pace = step.pace

    def after_frame(self) -> None:
        """Let the session's file keep up."""
        if self.recorder is not None:
            self.recorder.keep_up()

    def while_running(self) -> None:
        """Let the session's file keep up while the solver is ahead: without a whole state."""
        if self.recorder is not None:
            self.recorder.keep_up(may_record_state=False)

    def _due(self, controls: Controls) -> Controls:
        """The controls, with those that had to wait: between a mark or a cut and what restores states there is a step at least, so that no two
        states have one index.
        """
        asked = {
            name: getattr(controls, name) or self._waiting.get(name, NOTHING[name]) for name in AFTER_ACTION
        }
        waits = self.session.step_index == self._acted_at
        self._waiting = {name: value for name, value in asked.items() if value} if waits else {}
        return replace(controls, **({name: NOTHING[name] for name in AFTER_ACTION} if waits else asked))

    def _operate(self, controls: Controls) -> None:
        """Set marks of the score, or cut, as the user or the script asks for it: one of these in a step. Say what cannot be done."""
        settings = controls.settings
        script_is_due = self.script is not None and self.script.is_due(self.session.time_s)
        if self.session.step_index == self._acted_at:
            return
        if controls.score_under is not None:
            ray = controls.score_under
            self._act(lambda: set_marks(self.session, mark_under(self.session.rehearsal, *ray)))
        elif controls.score_image:
            self._act(
                lambda: set_marks(
                    self.session, marks_of_image(self.session.rehearsal, float(settings.margin_mm))
                )
            )
        elif controls.score_planned:
            self._act(self._score_planned)
        elif controls.cut_out:
            self._act(lambda: self._cut(cut_settings(settings)))
        elif script_is_due and self.script is not None:
            action = self.script.take()
            self._act(lambda: self._follow_script(action))

    def _follow_script(self, action: ScriptedAction) -> None:
        if action.score == "image":
            set_marks(self.session, marks_of_image(self.session.rehearsal, action.margin_mm))
        elif action.score is not None:
            set_marks(self.session, places_at_rest(self.session.rehearsal, np.array(action.score, float)))
        if action.cut is not None:
            self._cut(action.cut)

    def _score_planned(self) -> None:
        if self.resection_plan is None:
            raise ResectionError(
                "no planned line; make a plan with app.py plan --resect, and open it with --plan"
            )
        planned = self.resection_plan.best
        places = places_at_rest(self.session.rehearsal, np.array(planned.marks_mm))
        set_marks(self.session, places, replaces=True)
        self.notices.post(
            f"Planned line: for {planned.technique} with a margin of {self.resection_plan.margin_mm:g} mm; {{technique}} chooses the technique"
        )

    def _cut(self, settings: CutSettings) -> None:
        # Without a CT there are no images that could have shown the tumour.
        coverage = self.session.coverage if self.session.rehearsal.scanner is not None else None
        cut(self.session, settings, None if coverage is None else coverage().is_seen)
        made, judgement = self.session.rehearsal.cut, self.session.rehearsal.judgement
        seen, is_as_deep = seen_share(self.session.rehearsal), settings.depth_mm is None
        warnings = [
            *([UNSEEN.format(100 * seen)] if is_as_deep and seen < LEAST_SEEN else []),
            *(made.warnings if made is not None else ()),
            *(judgement.warnings() if judgement is not None else ()),
        ]
        fault = self.session.rehearsal.judgement_fault
        for warning in [*warnings, *([fault] if fault else [])]:
            self.notices.post(f"Warning: {warning}")

    def _act(self, action: Callable[[], None]) -> None:
        """Do something that undo reverts; say why it cannot be done."""
        before = self.session.rehearsal.resection
        step = self.session.keep_state()
        try:
            action()
        except UserError as error:
            self.notices.post(str(error))
        if self.session.rehearsal.resection != before:
            self.history.begin_at(step)
            self._acted_at = self.session.step_index

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

    def _tracked_pose(self, follower: TrackingInput, controls: Controls, time_s: float) -> np.ndarray:
        """The next pose towards the tracked probe."""
        manipulator = self.session.rehearsal.manipulator
        try:
            goal = follower.goal()
        except TrackEnded as over:
            self._follower = None
            self._show(str(over))
            self._wait(controls.ray)
            return self._goal
        pose = self._goal if goal is None else manipulator.pose_towards(goal, self._goal, time_s)
        manipulator.match(pose)
        return pose

    def _manual_pose(self, controls: Controls, time_s: float) -> np.ndarray:
        """The next pose as mouse, keys and gamepad ask for it."""
        if self.waits and self._ray is None:
            self._ray = controls.ray
        self.waits = self.waits and not acts(controls, self._ray)
        if self.waits:
            return self._goal
        return self._moved_manipulator(controls, time_s)

    def _moved_manipulator(self, controls: Controls, time_s: float) -> np.ndarray:
        manipulator = self.session.rehearsal.manipulator
        if any(controls.slide_mm):
            manipulator.slide(*controls.slide_mm)
            self._ray_at_slide = controls.ray
        elif controls.ray is not None and mouse_moved(controls.ray, self._ray_at_slide):
            manipulator.point(*controls.ray)
            self._ray_at_slide = None
        manipulator.press(controls.press, time_s, controls.press_share)
        manipulator.push(controls.push_mm)
        manipulator.turn(controls.tilt_deg, controls.rock_deg, controls.rotate_deg)
        return manipulator.pose_towards(manipulator.pose(), self._goal, time_s)

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
        values = solver_values(settings)
        self._solver_values = values
        # The iterations that a step had are noted with it.
        noted = {name: value for name, value in values.items() if name != "iterations"}
        self.session.note_changes("solver", noted)
        set_solver(self.session.rehearsal, values)


def solver_values(settings: TissueSettings) -> dict[str, Any]:
    """The settings of solver and tissue that the tissue model has."""
    values = dict(
        iterations=settings.iterations,
        substeps=settings.substeps,
        stiffness=settings.stiffness,
        young_kpa=settings.young_kpa,
        gravity_m_s2=settings.gravity_m_s2,
    )
    return {name: value for name, value in values.items() if value is not None}


def acts(controls: Controls, ray: Ray | None) -> bool:
    """Whether the user does anything but keep the mouse on a ray."""
    turns = controls.push_mm, controls.tilt_deg, controls.rock_deg, controls.rotate_deg
    return mouse_moved(controls.ray, ray) or controls.press or any(turns) or any(controls.slide_mm)


def mouse_moved(ray: Ray | None, before: Ray | None) -> bool:
    """Whether the mouse is on a ray, and on another than before."""
    if ray is None or before is None:
        return ray is not None
    return not all(np.array_equal(a, b) for a, b in zip(ray, before, strict=True))
