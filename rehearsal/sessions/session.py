"""A rehearsal as a sequence of steps and rollbacks; undo, redo and bookmarks, which restore states of it."""

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from rehearsal.rehearsal import Rehearsal, RehearsalState
from rehearsal.sessions.packed_arrays import SeenVoxels, pack_seen, pack_state
from rehearsal.sessions.session_file import Kind
from ultrasound.coverage import Coverage
from ultrasound.probe_manipulator import ManipulatorState

# The index before the first step: tissue settled, transducer just touching.
SETTLED = -1
MOST_UNDONE = 40
# Input that follows the last one sooner than this belongs to the same action; an action lasts no longer than that.
PAUSE_S, LONGEST_S = 0.5, 5.0


class Recorder(Protocol):
    """Records what happens in a session."""

    def note(self, kind: Kind, value: Any) -> None: ...

    def add_step(
        self, pose: np.ndarray | None, length_s: float, wrench: np.ndarray | None = None
    ) -> None: ...


class Session:
    """``step_index`` counts the steps and the rollbacks since the session began, so that no two states share an index.

    ``time_s`` is the simulated time since then: the sum of the steps' lengths, where a rollback counts as a step of the scene's length.
    ``recorder``, if any, gets everything that a replay needs. ``coverage`` returns what of the organ has been imaged so far. ``rolled_back_to`` is the index that the last rollback restored, None after a step; ``rollbacks`` counts them.
    """

    def __init__(
        self,
        rehearsal: Rehearsal,
        recorder: Recorder | None = None,
        coverage: Callable[[], Coverage] | None = None,
    ) -> None:
        self.rehearsal = rehearsal
        self.recorder = recorder
        self.coverage = coverage
        self.step_index = 0
        self.time_s = 0.0
        self.rolled_back_to: int | None = None
        self.rollbacks = 0
        self.kept_states: dict[int, RehearsalState] = {SETTLED: rehearsal.settled}
        self._noted: dict[str, Any] = {}

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

    def end_step(
        self,
        pose: np.ndarray | None = None,
        length_s: float | None = None,
        wrench: np.ndarray | None = None,
    ) -> None:
        """Count a step that was made: to a pose (4, 4), of a length [s], with a wrench (6,) on the probe.

        Pose and length that are left out are the rehearsal's present ones.
        """
        self.rolled_back_to = None
        self._count(self.rehearsal.pose if pose is None else pose, length_s, wrench)

    def roll_back(self, step_index: int) -> None:
        """Restore a state that was kept; time goes on."""
        self.note("back", step_index)
        self.rehearsal.restore(self.kept_states[step_index])
        self.rehearsal.update_surfaces()
        self.rolled_back_to = step_index
        self.rollbacks += 1
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
        self.rehearsal.store_valid_state()
        self.note("state", pack_state(self.rehearsal.snapshot()))
        coverage = self.packed_coverage()
        if coverage is not None:
            self.note("seen", coverage)

    def packed_coverage(self) -> SeenVoxels | None:
        """The voxels imaged so far; None if nobody measures them."""
        return None if self.coverage is None else pack_seen(self.coverage().seen)

    def discard_states_but(self, needed: set[int]) -> None:
        """Discard the kept states that are no longer needed."""
        self.kept_states = {
            index: state for index, state in self.kept_states.items() if index in {SETTLED, *needed}
        }

    def _count(
        self, pose: np.ndarray | None, length_s: float | None = None, wrench: np.ndarray | None = None
    ) -> None:
        length_s = length_s or self.rehearsal.settings.time_step_s
        if self.recorder is not None:
            self.recorder.add_step(pose, length_s, wrench)
        self.step_index += 1
        self.time_s += length_s


class History:
    """An action is what the user does without a pause: a press, a turn, a path over the organ. Undo restores the state before it."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.undone: list[int] = []
        self.bookmarks: list[int] = []
        self._before: deque[int] = deque(maxlen=MOST_UNDONE)
        self._began_s = self._acted_s = -LONGEST_S
        self._at = 0
        self._was_pressing = False

    def watch(self, is_acting: bool, is_pressing: bool, manipulator: ManipulatorState | None = None) -> None:
        """Note the user's input before its step; ``manipulator`` is the manipulator's state before this input."""
        now, begins = self.session.time_s, is_pressing and not self._was_pressing
        self._was_pressing = is_pressing
        if not is_acting:
            return
        if begins or now - self._acted_s > PAUSE_S or now - self._began_s > LONGEST_S:
            self.begin(manipulator)
        self._acted_s = now

    def begin(self, manipulator: ManipulatorState | None = None) -> None:
        """Begin an action, so that undo restores the present state."""
        self._began_s = self.session.time_s
        self._at = 0
        self.begin_at(self.session.keep_state(manipulator))

    def begin_at(self, step_index: int) -> None:
        """Begin an action whose state before it was kept under an index."""
        self._before.append(step_index)
        self.undone.clear()
        self._discard()

    def undo(self) -> bool:
        """Restore the state before the last action; return whether there was one."""
        if not self._before:
            return False
        self.undone.append(self.session.keep_state())
        self._restore(self._before.pop())
        return True

    def redo(self) -> bool:
        """Revert the last undo; return whether there was one."""
        if not self.undone:
            return False
        self._before.append(self.session.keep_state())
        self._restore(self.undone.pop())
        return True

    def reset(self) -> None:
        """Restore the settled tissue: an action that can be undone."""
        self.begin()
        self._restore(SETTLED)

    def set_bookmark(self) -> int:
        """Keep this state; return the number of bookmarks."""
        # A replay can start here, however much later the bookmark is used.
        self.session.record_state()
        self.bookmarks.append(self.session.keep_state())
        self._at = 0
        self.session.note("bookmark", len(self.bookmarks))
        return len(self.bookmarks)

    def to_bookmark(self) -> int:
        """Restore the last bookmark, or the one before it when called again; return its number, 0 if there is none."""
        if not self.bookmarks:
            return 0
        at = (self._at - 1) % len(self.bookmarks)
        self.begin()
        self._at = at
        self._restore(self.bookmarks[at])
        return at + 1

    def _restore(self, step_index: int) -> None:
        self.session.roll_back(step_index)
        self._acted_s = -LONGEST_S
        self._discard()

    def _discard(self) -> None:
        self.session.discard_states_but({*self._before, *self.undone, *self.bookmarks})
