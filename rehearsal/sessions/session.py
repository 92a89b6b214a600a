"""A rehearsal as a sequence of steps and rollbacks: the basis of undo, bookmarks and replay."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.sessions.packed_coverage import SeenVoxels, pack_seen
from rehearsal.sessions.packed_state import to_text
from rehearsal.sessions.session_file import Kind
from ultrasound.probe_manipulator import ManipulatorState

# The index before the first step: tissue settled, transducer just touching.
SETTLED = -1


class Recorder(Protocol):
    """Records what happens in a session."""

    def note(self, kind: Kind, value: Any) -> None: ...

    def add_step(self, pose: np.ndarray | None) -> None: ...


class Session:
    """``step_index`` counts the steps and the rollbacks since the session began, so that no two states share an index.

    ``recorder``, if any, gets everything that a replay needs. ``coverage`` returns which voxels (nx, ny, nz) of the organ have been
    imaged so far. ``rolled_back_to`` is the index that the last rollback restored, None after a step.
    """

    def __init__(
        self,
        rehearsal: Rehearsal,
        recorder: Recorder | None = None,
        coverage: Callable[[], np.ndarray] | None = None,
    ) -> None:
        self.rehearsal = rehearsal
        self.recorder = recorder
        self._coverage = coverage
        self.step_index = 0
        self.rolled_back_to: int | None = None
        self.kept_states: dict[int, RehearsalState] = {SETTLED: rehearsal.settled}
        self._noted: dict[str, Any] = {}

    @property
    def time_s(self) -> float:
        """Simulated time since the session began."""
        return self.step_index * self.rehearsal.settings.time_step_s

    def note_changes(self, kind: Kind, values: dict[str, Any]) -> None:
        """Note those of some values that differ from the last ones noted."""
        new = {name: value for name, value in values.items() if self._noted.get(f"{kind}.{name}") != value}
        if new:
            self._noted |= {f"{kind}.{name}": value for name, value in new.items()}
            self.note(kind, new)

    def note(self, kind: Kind, value: Any) -> None:
        """Note something about the coming step."""
        if self.recorder is not None:
            self.recorder.note(kind, value)

    def end_step(self) -> None:
        """Count the step that the rehearsal has just made."""
        self.rolled_back_to = None
        self._count(self.rehearsal.pose)

    def roll_back(self, step_index: int) -> None:
        """Restore a state that was kept; time goes on."""
        self.note("back", step_index)
        self.rehearsal.restore(self.kept_states[step_index])
        self.rehearsal.update_surfaces()
        self.rolled_back_to = step_index
        self._count(None)

    def keep_state(self, manipulator: ManipulatorState | None = None) -> int:
        """Keep the present state for a rollback, with the manipulator's present state or another one; return its index."""
        if self.step_index not in self.kept_states:
            self.kept_states[self.step_index] = self.rehearsal.snapshot(manipulator)
        return self.step_index

    def record_state(self) -> None:
        """Note the whole present state, so that a replay can start here.

        The tissue also becomes what the divergence check would restore, so that it is recorded once; a replay does the same.
        """
        self.rehearsal.keep_good()
        self.note("state", to_text(self.rehearsal.snapshot()))
        coverage = self.packed_coverage()
        if coverage is not None:
            self.note("seen", coverage)

    def packed_coverage(self) -> SeenVoxels | None:
        """The voxels imaged so far; None if nobody measures them."""
        return None if self._coverage is None else pack_seen(self._coverage())

    def discard_states(self, is_needed: Callable[[int], bool]) -> None:
        """Discard the kept states that are no longer needed."""
        self.kept_states = {
            index: state for index, state in self.kept_states.items() if index == SETTLED or is_needed(index)
        }

    def _count(self, pose: np.ndarray | None) -> None:
        if self.recorder is not None:
            self.recorder.add_step(pose)
        self.step_index += 1
