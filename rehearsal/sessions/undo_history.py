"""Undo, redo and bookmarks: the states of a session that can be restored."""

from collections import deque

from rehearsal.sessions.session import SETTLED, Session
from ultrasound.probe_manipulator import ManipulatorState

MOST_UNDONE = 40
# Input that follows the last one sooner than this belongs to the same action; an action lasts no longer than that.
PAUSE_S, LONGEST_S = 0.5, 5.0


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
            self._begin(manipulator)
        self._acted_s = now

    def _begin(self, manipulator: ManipulatorState | None = None) -> None:
        self._began_s = self.session.time_s
        self._at = 0
        self._before.append(self.session.keep_state(manipulator))
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
        self._begin()
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
        self._begin()
        self._at = at
        self._restore(self.bookmarks[at])
        return at + 1

    def _restore(self, step_index: int) -> None:
        self.session.roll_back(step_index)
        self._acted_s = -LONGEST_S
        self._discard()

    def _discard(self) -> None:
        needed = {*self._before, *self.undone, *self.bookmarks}
        self.session.discard_states(needed.__contains__)
