"""Replay a recorded session, bit for bit."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.resection.operation import repeat_cut, repeat_marks
from rehearsal.resection.score_line import ResectionError
from rehearsal.sessions.packed_arrays import StateError, unpack_state
from rehearsal.sessions.session import SETTLED, Session
from rehearsal.sessions.session_file import Log, SessionError

# Times are sums of steps.
ROUNDING_S = 1e-9
# Events that change the tissue, or the solver's settings.
CHANGING = ("solver", "back", "state", "marks", "cut")


class Replay:
    """Repeat a log on a rehearsal. ``differs_s`` is the time [s] at which the tissue first differed from the recorded one, if it did;
    ``state`` is its digest at the last comparison; ``bookmarks`` counts those set so far.

    Raises SessionError if the log's states belong to another body.
    """

    def __init__(self, rehearsal: Rehearsal, log: Log) -> None:
        self.rehearsal, self.log = rehearsal, log
        self.session = Session(rehearsal)
        self.compared = self.bookmarks = 0
        self.state = ""
        self.differs_s: float | None = None
        backs = [
            (index, event.value) for index, e in log.events.items() for event in e if event.kind == "back"
        ]
        if not all(isinstance(to, int) and SETTLED <= to <= index for index, to in backs):
            raise SessionError("the session restores a step that had not been made: its file is damaged")
        if {index for index, _ in backs} != set(np.flatnonzero(np.isnan(log.poses).any(axis=(1, 2)))):
            raise SessionError("the session has a step without a pose: its file is damaged")
        self._backs = backs
        changing = {i for i, e in log.events.items() if any(event.kind in CHANGING for event in e)}
        # Steps before which something else than a step happens.
        self._stops = changing | set(log.digests) | {to for _, to in backs if isinstance(to, int)}
        if log.header.begins is not None:
            rehearsal.restore(self._state(log.header.begins))

    @property
    def is_over(self) -> bool:
        """Whether all steps have been made."""
        return self.session.step_index >= len(self.log.poses)

    @property
    def time_s(self) -> float:
        """Simulated time since the session began."""
        return self.session.time_s

    def begin_at(self, seconds: float) -> int:
        """Restore the last recorded state before a time [s] from which the rest can be replayed; return its step."""
        aim = self.log.step_at(seconds)
        start = max((index for index in self.log.states if index <= aim and self._holds(index)), default=0)
        if start > 0:
            for index in range(start):
                self._set(index, operates=False)
            self.rehearsal.restore(self._state(self.log.states[start]))
            self.session.step_index, self.session.time_s = start, float(self.log.lengths_s[:start].sum())
        self.rehearsal.update_surfaces()
        return start

    def go_to(self, seconds: float) -> Iterator[tuple[np.ndarray | None, dict[str, Any]]]:
        """Continue to a time [s] and yield what ``move`` returned for each step. The drawn surfaces are not updated."""
        aim = self.log.step_at(seconds)
        while self.session.step_index < aim:
            pose, settings = self.move()
            if pose is not None:
                self.rehearsal.advance(pose)
                self.end_step()
            yield pose, settings

    def move(self) -> tuple[np.ndarray | None, dict[str, Any]]:
        """Return the pose to step to, None for a rollback, and the settings of the images that changed; set the step's length.

        Call ``end_step`` after the step. Raises SessionError at the end of the log.
        """
        index = self.session.step_index
        if self.is_over:
            raise SessionError("the session is over")
        back, settings = self._set(index)
        self.rehearsal.settings.time_step_s = float(self.log.lengths_s[index])
        self._keep_if_needed(index)
        if back is not None:
            if back not in self.session.kept_states:
                self.session.kept_states[back] = self._state(self.log.states[back])
            self.session.roll_back(back)
            self._compare()
            return None, settings
        return self.log.poses[index], settings

    def next_steps(self, most_s: float) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
        """Poses (n, 4, 4) and lengths (n,) [s] of the next steps, and the settings of the images that change in them.

        They last about a time [s], and at most until something else happens than a step. A rollback, which is done here, has a length
        and no pose. Raises SessionError at the end of the log.
        """
        first = last = self.session.step_index
        pose, settings = self.move()
        lengths_s = self.log.lengths_s
        if pose is None:
            return self.log.poses[:0], lengths_s[first : first + 1], settings
        last += 1
        while last < len(self.log.poses) and last not in self._stops:
            if lengths_s[first : last + 1].sum() > most_s + ROUNDING_S:
                break
            settings |= self._set(last)[1]
            last += 1
        return self.log.poses[first:last], lengths_s[first:last], settings

    def end_step(
        self, pose: np.ndarray | None = None, length_s: float | None = None, wrench: np.ndarray | None = None
    ) -> None:
        """Count a step that was made; left out, pose and length are the rehearsal's present ones."""
        self.session.end_step(pose, length_s, wrench)
        self._compare()

    def _set(self, index: int, operates: bool = True) -> tuple[int | None, dict[str, Any]]:
        """Set solver and tissue as at a step; return the step that it restores, if any, and its settings of the images.

        A recorded state holds marks and cut: before one is restored they are not to be made (``operates``).
        """
        back: int | None = None
        settings: dict[str, Any] = {}
        for event in self.log.events.get(index, []):
            if event.kind in ("marks", "cut") and operates:
                # Undo restores the state before them.
                self._keep_if_needed(index)
                self._operate(event.kind, event.value)
            if event.kind == "solver":
                set_solver(self.rehearsal, event.value)
            elif event.kind == "settings":
                settings |= event.value
            elif event.kind == "back":
                back = event.value
            elif event.kind == "state":
                self.rehearsal.store_valid_state()
            elif event.kind == "bookmark":
                self.bookmarks += 1
        return back, settings

    def _keep_if_needed(self, index: int) -> None:
        """Keep the present state if a later rollback restores it."""
        if self.session.step_index == index and any(to == index for _, to in self._backs):
            self.session.keep_state()

    def _operate(self, kind: str, value: Any) -> None:
        """Set the recorded marks, or cut. Raises SessionError."""
        try:
            if kind == "marks":
                repeat_marks(self.rehearsal, value)
            else:
                repeat_cut(self.rehearsal, value)
        except (ResectionError, ValueError) as error:
            raise SessionError(f"the session's {kind} cannot be repeated: {error}") from None

    def settings_until_now(self) -> dict[str, Any]:
        """The settings of the images at the present step."""
        settings: dict[str, Any] = {}
        for index in sorted(m for m in self.log.events if m <= self.session.step_index):
            for event in self.log.events[index]:
                settings |= event.value if event.kind == "settings" else {}
        return settings

    def _compare(self) -> None:
        digest = self.log.digests.get(self.session.step_index)
        if digest is None:
            return
        self.compared += 1
        self.state = self.rehearsal.digest()
        if self.differs_s is None and digest != self.state:
            self.differs_s = self.time_s

    def _holds(self, start: int) -> bool:
        """Whether no later rollback restores a state from before a step that was not recorded."""
        return all(
            index < start or to >= start or to == SETTLED or to in self.log.states
            for index, to in self._backs
        )

    def _state(self, text: str) -> RehearsalState:
        try:
            state = unpack_state(text, self.rehearsal.settled)
        except StateError as error:
            raise SessionError(f"the session holds {error}: it is damaged, or of another body") from None
        bodies = state.solver.body, state.divergence.good.body
        if not all(np.isfinite(values).all() for body in bodies for values in (body.position, body.velocity)):
            raise SessionError("the session holds a state of tissue that is not finite: its file is damaged")
        return state


def set_solver(rehearsal: Rehearsal, values: dict[str, Any]) -> None:
    """Set the recorded values of solver and material."""
    step = rehearsal.settings
    for name in ("iterations", "substeps", "stiffness"):
        setattr(step, name, values.get(name, getattr(step, name)))
    if "young_kpa" in values:
        rehearsal.set_young(values["young_kpa"])
    if "gravity_m_s2" in values:
        rehearsal.set_gravity(values["gravity_m_s2"])
