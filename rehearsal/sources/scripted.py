"""The scene's scripted press, and a replay that the user may take over."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from rehearsal.live_settings import LiveSettings
from rehearsal.loop.command import Command, Move, NewSession, SetValues
from rehearsal.loop.frame import Frame
from rehearsal.loop.protocols import Source
from rehearsal.notices import Notices
from rehearsal.sessions.replay import Replay
from render.viewer import Controls
from settings import live_values


class ScriptedPress:
    """A ``Source``: moves along ``pose_at`` (share of the press -> pose (4, 4)), in so many steps."""

    status = ""

    def __init__(self, pose_at: Callable[[float, np.ndarray], np.ndarray], steps: int) -> None:
        self._pose_at, self._steps, self._made = pose_at, steps, 0

    def commands(self, frame: Frame, controls: Controls[LiveSettings], elapsed_s: float) -> Iterator[Command]:
        """As ``Source.commands``: one move."""
        if self._made == 0:
            yield SetValues(values=live_values(controls.settings))
        self._made += 1
        yield Move(pose=self._pose_at(self._made / self._steps, frame.pose))


class ReplaySource:
    """A ``Source``: a recorded session, until it ends or the user takes over.

    From then on what ``user()`` makes, in a new session.
    """

    def __init__(self, replay: Replay, user: Callable[[], Source], notices: Notices) -> None:
        self.replay, self._make_user, self._notices = replay, user, notices
        self.user: Source | None = None

    @property
    def status(self) -> str:
        """As ``Source.status``."""
        return "" if self.user is None else self.user.status

    @property
    def replay_status(self) -> str:
        """For the window while the recorded session is shown."""
        return self.replay.status if self.user is None else ""

    def commands(self, frame: Frame, controls: Controls[LiveSettings], elapsed_s: float) -> Iterable[Command]:
        """As ``Source.commands``. Raises SessionError."""
        if self.user is not None:
            return self.user.commands(frame, controls, elapsed_s)
        if controls.frozen:
            return []
        if not controls.take_over and not (
            self.replay.is_over and frame.number >= self.replay.log.last_number
        ):
            return self.replay.commands(frame, controls, elapsed_s)
        ended = "" if controls.take_over else "The replay has ended. "
        self._notices.post(f"{ended}Mouse and keys control the probe", in_terminal=False)
        self.user = self._make_user()
        return [NewSession(), *self.user.commands(frame, replace(controls, take_over=False), elapsed_s)]
