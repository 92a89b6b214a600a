"""Input sources, which move the transducer: the user (``user_input.py``), a recorded session, or the scene's scripted press."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, Protocol

import numpy as np

from errors import FOUND
from rehearsal.inputs.user_input import UserInput
from rehearsal.notices import Notices
from rehearsal.pressed_organ import Step
from rehearsal.real_time.solver_process import SolverProcess
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.replay import ROUNDING_S, Replay
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import SessionError
from render.viewer import TECHNIQUES, Controls, Settings
from ultrasound.probe import DETAIL_LEVELS, DOPPLER_MODES, MODES
from ultrasound.target import TARGETS

CHOICES: dict[str, tuple[str, ...]] = {
    "mode": MODES,
    "detail_level": DETAIL_LEVELS,
    "doppler": DOPPLER_MODES,
    "plan_for": TARGETS,
    "technique": TECHNIQUES,
}


# A replay that is further behind than this goes on from there.
MOST_DUE_S = 0.25


class InputSource(Protocol):
    """Each frame: ``next_pose``; where that gave a pose, the step and ``after_step``; then ``after_frame``."""

    @property
    def session(self) -> Session:
        """The session that the steps belong to."""

    @property
    def status(self) -> str:
        """The text in the panel; empty if there is none."""

    @property
    def bookmarks(self) -> int:
        """Number of bookmarks in the session."""

    def next_pose(self, controls: Controls) -> np.ndarray | None:
        """Return the pose (4, 4) to step to; None where the state was restored to an earlier one."""

    def after_step(self, step: Step) -> None:
        """Note a step that was made."""

    def after_frame(self) -> None:
        """The frame is complete."""


class WindowInput(InputSource, Protocol):
    """An input source for a window, where the solver makes steps by itself."""

    def drive(self, solver: SolverProcess, controls: Controls, elapsed_s: float) -> None:
        """Tell the solver what to do, after a time [s]; ``after_step`` follows for each step."""

    def while_running(self) -> None:
        """The frame is complete, and the solver may be ahead of the rehearsal."""


class ReplayInput:
    """A recorded session, until it ends or the user takes over: from then on what ``user_input()`` makes."""

    def __init__(
        self, replay: Replay, user_input: Callable[[], UserInput], notices: Notices | None = None
    ) -> None:
        self.replay, self._make_user_input = replay, user_input
        self.user_input: UserInput | None = None
        self.notices = notices or Notices()
        self._has_warned = False
        self._due_s = 0.0

    @property
    def _source(self) -> "UserInput | Replay":
        return self.user_input or self.replay

    @property
    def session(self) -> Session:
        return self._source.session

    @property
    def status(self) -> str:
        if self.user_input is not None:
            return self.user_input.status
        return f"REPLAY   {self.replay.time_s:.1f} s   {{take_over}} takes control"

    @property
    def bookmarks(self) -> int:
        return self._source.bookmarks

    def next_pose(self, controls: Controls) -> np.ndarray | None:
        controls = self._with_take_over(controls)
        if self.user_input is not None:
            return self.user_input.next_pose(controls)
        pose, settings = self.replay.move()
        set_settings(controls.settings, settings)
        return pose

    def drive(self, solver: SolverProcess, controls: Controls, elapsed_s: float) -> None:
        """Play what was recorded in a time [s], once the steps before are made."""
        if self.user_input is None:
            solver.pause()
        controls = self._with_take_over(controls)
        if self.user_input is not None:
            self.user_input.drive(solver, controls, elapsed_s)
            return
        self._due_s = min(self._due_s + elapsed_s, MOST_DUE_S)
        poses = np.zeros((0, 4, 4))
        while self._due_s > ROUNDING_S and not self.replay.is_over and len(poses) == 0:
            poses, lengths_s, settings = self.replay.next_steps(self._due_s)
            set_settings(controls.settings, settings)
            self._due_s -= lengths_s.sum()
        if len(poses):
            solver.hand_over()
            solver.play(poses, lengths_s)

    def _with_take_over(self, controls: Controls) -> Controls:
        """The controls; at the end of the replay, or when the user takes over, mouse and keys control the probe."""
        if self.user_input is not None or not (controls.take_over or self.replay.is_over):
            return controls
        ended = "" if controls.take_over else "The replay has ended. "
        self.notices.post(f"{ended}Mouse and keys control the probe", in_terminal=False)
        self.user_input = self._make_user_input()
        return replace(controls, take_over=False)

    def after_step(self, step: Step) -> None:
        if self.user_input is not None:
            self.user_input.after_step(step)
            return
        self.replay.end_step(step.pose, step.length_s, step.wrench)
        if self.replay.differs_s is not None and not self._has_warned:
            self._has_warned = True
            self.notices.post(
                f"Warning: from {self.replay.differs_s:.0f} s on the tissue differs from the recorded one.",
                on_screen=False,
            )

    def after_frame(self) -> None:
        if self.user_input is not None:
            self.user_input.after_frame()

    def while_running(self) -> None:
        """Let the session's file keep up, if there is one."""
        if self.user_input is not None:
            self.user_input.while_running()


def set_settings(settings: Settings, values: dict[str, Any]) -> None:
    """Set what a session recorded. Raises SessionError for an unknown setting or a value out of its range."""
    known = {each.name: each.metadata for each in fields(settings)}
    for name, value in values.items():
        if name not in known or not _fits(getattr(settings, name), value, name, known[name]):
            raise SessionError(
                f"the session sets {name} to {FOUND.repr(value)}, which it cannot be: its file is damaged"
            )
        setattr(settings, name, value)


def _fits(usual: Any, value: Any, name: str, about: Mapping[str, Any]) -> bool:
    """Whether a value is of a setting's kind and within its slider."""
    if name in CHOICES:
        return value in CHOICES[name]
    if value is None:
        return usual is None
    if isinstance(usual, bool) or isinstance(value, bool):
        return type(value) is type(usual)
    if not isinstance(value, int if isinstance(usual, int) else (int, float)):
        return False
    return not about or bool(about["low"] <= value <= about["high"])


class ScriptedInput:
    """The scene's scripted press in so many steps."""

    def __init__(self, session: Session, recorder: SessionRecorder | None, steps: int) -> None:
        self.session, self.recorder, self.steps = session, recorder, steps
        self.status, self.bookmarks = "", 0

    def next_pose(self, controls: Controls) -> np.ndarray | None:
        rehearsal = self.session.rehearsal
        share = (self.session.step_index + 1) / self.steps
        return rehearsal.pose_towards(rehearsal.scripted_pose(rehearsal.script_length_s() * share))

    def after_step(self, step: Step) -> None:
        self.session.end_step(step.pose, step.length_s, step.wrench)

    def after_frame(self) -> None:
        if self.recorder is not None:
            self.recorder.keep_up()
