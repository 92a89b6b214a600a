"""A recorded session once more, with the same bits."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.sessions.packed_state import StateError, from_text
from rehearsal.sessions.session import SETTLED, Session
from rehearsal.sessions.session_file import Log, SessionError


class Replay:
    """Drives a rehearsal through a log. ``differs_s`` is when its tissue first was not the recorded one's, None so far; ``state`` its
    digest when it was compared last. ``bookmarks`` counts those set so far.

    Raises SessionError where the log's states are of another body.
    """

    def __init__(self, rehearsal: Rehearsal, log: Log) -> None:
        self.rehearsal, self.log = rehearsal, log
        self.session = Session(rehearsal)
        self.compared = self.bookmarks = 0
        self.state = ""
        self.differs_s: float | None = None
        backs = [
            (moment, event.value) for moment, e in log.events.items() for event in e if event.kind == "back"
        ]
        if not all(isinstance(to, int) and SETTLED <= to <= moment for moment, to in backs):
            raise SessionError("the session goes back to a moment that had not been: its file is damaged")
        if {moment for moment, _ in backs} != set(np.flatnonzero(np.isnan(log.poses).any(axis=(1, 2)))):
            raise SessionError("the session has a moment without a pose: its file is damaged")
        self._backs = backs
        if log.header.begins is not None:
            rehearsal.restore(self._state(log.header.begins))

    @property
    def is_over(self) -> bool:
        """Whether there is no moment left."""
        return self.session.moment >= len(self.log.poses)

    @property
    def time_s(self) -> float:
        """Simulated time since the session began."""
        return self.session.time_s

    def moment_at(self, seconds: float) -> int:
        """The moment at a time, or the last."""
        return min(round(seconds / self.log.header.time_step_s), len(self.log.poses))

    def begin_at(self, seconds: float) -> int:
        """Go to the last state before a time that all which follows can be had from; the moment that it is of."""
        aim = self.moment_at(seconds)
        start = max(
            (moment for moment in self.log.states if moment <= aim and self._holds(moment)), default=0
        )
        if start > 0:
            for moment in range(start):
                self._set(moment)
            self.rehearsal.restore(self._state(self.log.states[start]))
            self.session.moment = start
        self.rehearsal.update_surfaces()
        return start

    def go_to(self, seconds: float) -> Iterator[tuple[np.ndarray | None, dict[str, Any]]]:
        """Go on to a time; after each moment what ``move`` had for it. The surfaces are left behind."""
        aim = self.moment_at(seconds)
        while self.session.moment < aim:
            pose, settings = self.move()
            if pose is not None:
                self.rehearsal.advance(pose)
                self.stepped()
            yield pose, settings

    def move(self) -> tuple[np.ndarray | None, dict[str, Any]]:
        """The pose to step to, None where this moment was a way back; and the pictures' settings that changed.

        ``stepped`` comes after the step. Raises SessionError where the log is over.
        """
        moment = self.session.moment
        if self.is_over:
            raise SessionError("the session is over")
        back, settings = self._set(moment)
        if any(to == moment for _, to in self._backs):
            self.session.keep()
        if back is not None:
            if back not in self.session.kept:
                self.session.kept[back] = self._state(self.log.states[back])
            self.session.go_back(back)
            self._compare()
            return None, settings
        return self.log.poses[moment], settings

    def stepped(self) -> None:
        """The rehearsal has just advanced to the pose of a move."""
        self.session.stepped()
        self._compare()

    def _set(self, moment: int) -> tuple[int | None, dict[str, Any]]:
        """Set solver and tissue as a moment has them; where it goes back to, and its pictures' settings."""
        back: int | None = None
        settings: dict[str, Any] = {}
        for event in self.log.events.get(moment, []):
            if event.kind == "solver":
                set_solver(self.rehearsal, event.value)
            elif event.kind == "settings":
                settings |= event.value
            elif event.kind == "back":
                back = event.value
            elif event.kind == "state":
                self.rehearsal.keep_good()
            elif event.kind == "bookmark":
                self.bookmarks += 1
        return back, settings

    def settings_until_now(self) -> dict[str, Any]:
        """The pictures' settings as they have become since the beginning."""
        settings: dict[str, Any] = {}
        for moment in sorted(m for m in self.log.events if m <= self.session.moment):
            for event in self.log.events[moment]:
                settings |= event.value if event.kind == "settings" else {}
        return settings

    def _compare(self) -> None:
        digest = self.log.digests.get(self.session.moment)
        if digest is None:
            return
        self.compared += 1
        self.state = self.rehearsal.digest()
        if self.differs_s is None and digest != self.state:
            self.differs_s = self.time_s

    def _holds(self, start: int) -> bool:
        """Whether nothing after a moment goes back to before it."""
        return all(
            moment < start or to >= start or to == SETTLED or to in self.log.states
            for moment, to in self._backs
        )

    def _state(self, text: str) -> RehearsalState:
        try:
            return from_text(text, self.rehearsal.settled)
        except StateError as error:
            raise SessionError(f"the session holds {error}: it is damaged, or of another body") from None


def set_solver(rehearsal: Rehearsal, values: dict[str, Any]) -> None:
    """Set what a step is told, as recorded."""
    step = rehearsal.settings
    for name in ("iterations", "substeps", "stiffness"):
        setattr(step, name, values.get(name, getattr(step, name)))
    if "young_kpa" in values:
        rehearsal.set_young(values["young_kpa"])
    if "gravity_m_s2" in values:
        rehearsal.set_gravity(values["gravity_m_s2"])
