"""A rehearsal as a row of moments, each a step or a way back to an earlier one: what undo, bookmarks and replay stand on."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.sessions.packed_coverage import SeenVoxels, pack_seen
from rehearsal.sessions.packed_state import to_text
from rehearsal.sessions.session_file import Kind

# The moment before the first: tissue settled, transducer just touching.
SETTLED = -1


class Recorder(Protocol):
    """What is told of each moment."""

    def note(self, kind: Kind, value: Any) -> None: ...

    def moment(self, pose: np.ndarray | None) -> None: ...


class Session:
    """``moment`` counts what has happened to a rehearsal since the session began, ways back too: no two states share one.

    ``recorder``, where there is one, is told of all, so that the same session can be had again; ``seen``, where somebody looks, says
    which voxels (nx, ny, nz) of the organ were seen so far. ``back`` is the moment that the last one went back to, None where that
    was a step.
    """

    def __init__(
        self,
        rehearsal: Rehearsal,
        recorder: Recorder | None = None,
        seen: Callable[[], np.ndarray] | None = None,
    ) -> None:
        self.rehearsal = rehearsal
        self.recorder = recorder
        self._seen = seen
        self.moment = 0
        self.back: int | None = None
        self.kept: dict[int, RehearsalState] = {SETTLED: rehearsal.settled}
        self._told: dict[str, Any] = {}

    @property
    def time_s(self) -> float:
        """Simulated time since the session began."""
        return self.moment * self.rehearsal.settings.time_step_s

    def tell(self, kind: Kind, values: dict[str, Any]) -> None:
        """Note those of some values that are not as they were told last."""
        new = {name: value for name, value in values.items() if self._told.get(f"{kind}.{name}") != value}
        if new:
            self._told |= {f"{kind}.{name}": value for name, value in new.items()}
            self.note(kind, new)

    def note(self, kind: Kind, value: Any) -> None:
        """Note something of the moment to come."""
        if self.recorder is not None:
            self.recorder.note(kind, value)

    def stepped(self) -> None:
        """The rehearsal has just advanced by a step."""
        self.back = None
        self._end_moment(self.rehearsal.pose)

    def go_back(self, moment: int) -> None:
        """Tissue and probe as they were at a moment that was kept; the time goes on."""
        self.note("back", moment)
        self.rehearsal.restore(self.kept[moment])
        self.rehearsal.update_surfaces()
        self.back = moment
        self._end_moment(None)

    def keep(self) -> int:
        """Keep the state of this moment, to be gone back to; which moment it is."""
        if self.moment not in self.kept:
            self.kept[self.moment] = self.rehearsal.snapshot()
        return self.moment

    def store(self) -> None:
        """Note the whole state of this moment, from which the session can be had without all that was before.

        Its tissue becomes what its guard would put back, so that it need not be noted twice; a replay does the same.
        """
        self.rehearsal.keep_good()
        self.note("state", to_text(self.rehearsal.snapshot()))
        seen = self.seen()
        if seen is not None:
            self.note("seen", seen)

    def seen(self) -> SeenVoxels | None:
        """What was seen so far, packed; None where nobody looks."""
        return None if self._seen is None else pack_seen(self._seen())

    def forget(self, is_needed: Callable[[int], bool]) -> None:
        """Let go of what was kept and is no longer needed."""
        self.kept = {moment: s for moment, s in self.kept.items() if moment == SETTLED or is_needed(moment)}

    def _end_moment(self, pose: np.ndarray | None) -> None:
        if self.recorder is not None:
            self.recorder.moment(pose)
        self.moment += 1
