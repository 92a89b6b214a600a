"""Who leads the transducer in a rehearsal: the user (``live.py``), a recorded session, or the scene's script."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, Protocol

import numpy as np

from rehearsal.inputs.user_input import UserInput
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.replay import Replay
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import SessionError
from render.viewer import Controls, Settings
from ultrasound.probe import DETAIL_LEVELS, MODES
from ultrasound.target import TARGETS

CHOICES: dict[str, tuple[str, ...]] = {"mode": MODES, "detail_level": DETAIL_LEVELS, "plan_for": TARGETS}

# What sessions of version 1.0 call a setting -> its name now.
RENAMED = {"rung": "detail_level"}


class InputSource(Protocol):
    """For each moment: ``move``, then, where that gave a pose, the step and ``stepped``; then ``watch``."""

    @property
    def session(self) -> Session:
        """The session that the moments are of."""

    @property
    def status(self) -> str:
        """What stands in the panel; empty where there is nothing to say."""

    @property
    def bookmarks(self) -> int:
        """How many the session has."""

    def move(self, controls: Controls) -> np.ndarray | None:
        """The pose (4, 4) to step to; None where this moment goes back to another."""

    def stepped(self, step_ms: float) -> str:
        """The rehearsal has just advanced to that pose, in so many ms; what the terminal has to say of it."""

    def watch(self) -> str:
        """After each moment: what the terminal has to say of it."""

    def take_said(self) -> str:
        """What there was to say to the user since this was last asked."""


class ReplayInput:
    """A recorded session, a ``InputSource``, until it is over or the user takes over: from then on ``lead()``."""

    def __init__(self, replay: Replay, lead: Callable[[], UserInput]) -> None:
        self.replay, self._lead = replay, lead
        self.live: UserInput | None = None
        self._said = ""
        self._has_warned = False

    @property
    def session(self) -> Session:
        return self.live.session if self.live else self.replay.session

    @property
    def status(self) -> str:
        if self.live is not None:
            return self.live.status
        return f"REPLAY   {self.replay.time_s:.1f} s   {{take_over}} leads from here"

    @property
    def bookmarks(self) -> int:
        return self.live.bookmarks if self.live else self.replay.bookmarks

    def move(self, controls: Controls) -> np.ndarray | None:
        if self.live is None and (controls.take_over or self.replay.is_over):
            self._said = "Yours now" if controls.take_over else "The replay is over: yours now"
            self.live, controls = self._lead(), replace(controls, take_over=False)
        if self.live is not None:
            return self.live.move(controls)
        pose, settings = self.replay.move()
        set_settings(controls.settings, settings)
        return pose

    def stepped(self, step_ms: float) -> str:
        if self.live is not None:
            return self.live.stepped(step_ms)
        self.replay.stepped()
        if self.replay.differs_s is not None and not self._has_warned:
            self._has_warned = True
            return f"Mind: from {self.replay.differs_s:.0f} s on the tissue is not bit for bit the recorded one's."
        return ""

    def watch(self) -> str:
        return self.live.watch() if self.live else ""

    def take_said(self) -> str:
        said, self._said = self._said, ""
        return said or (self.live.take_said() if self.live else "")


def set_settings(settings: Settings, values: dict[str, Any]) -> None:
    """Set what a session says. Raises SessionError for what is no setting, or none that there can be."""
    known = {each.name: each.metadata for each in fields(settings)}
    for recorded, value in values.items():
        name = RENAMED.get(recorded, recorded)
        if name not in known or not _fits(getattr(settings, name), value, name, known[name]):
            raise SessionError(
                f"the session sets {name} to {value!r}, which it cannot be: its file is damaged"
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
    """The scene's scripted press in so many steps, a ``InputSource``."""

    def __init__(self, session: Session, recorded: SessionRecorder | None, steps: int) -> None:
        self.session, self.recorded, self.steps = session, recorded, steps
        self.status, self.bookmarks = "", 0

    def move(self, controls: Controls) -> np.ndarray | None:
        rehearsal = self.session.rehearsal
        share = (self.session.moment + 1) / self.steps
        return rehearsal.pose_towards(rehearsal.scripted_pose(rehearsal.script_length_s() * share))

    def stepped(self, step_ms: float) -> str:
        self.session.stepped()
        return ""

    def watch(self) -> str:
        return self.recorded.watch() if self.recorded else ""

    def take_said(self) -> str:
        return ""
