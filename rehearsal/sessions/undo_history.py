"""Undo, redo and bookmarks: which moments of a session there is to go back to."""

from collections import deque

from rehearsal.sessions.session import SETTLED, Session

MOST_UNDONE = 40
# Input that comes sooner than this after the last goes on with the same action; an action takes no longer than that.
PAUSE_S, LONGEST_S = 0.5, 5.0


class History:
    """An action is what the user does without a pause: a press, a turn, a way over the organ. Undo goes to before the last one."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.undone: list[int] = []
        self.bookmarks: list[int] = []
        self._before: deque[int] = deque(maxlen=MOST_UNDONE)
        self._began_s = self._acted_s = -LONGEST_S
        self._at = 0
        self._was_pressing = False

    def watch(self, is_acting: bool, is_pressing: bool) -> None:
        """Look at what the user does, before the step that does it."""
        now, begins = self.session.time_s, is_pressing and not self._was_pressing
        self._was_pressing = is_pressing
        if not is_acting:
            return
        if begins or now - self._acted_s > PAUSE_S or now - self._began_s > LONGEST_S:
            self._begin()
        self._acted_s = now

    def _begin(self) -> None:
        self._began_s = self.session.time_s
        self._at = 0
        self._before.append(self.session.keep())
        self.undone.clear()
        self._forget()

    def undo(self) -> bool:
        """Go to before the last action; whether there was one."""
        if not self._before:
            return False
        self.undone.append(self.session.keep())
        self._go(self._before.pop())
        return True

    def redo(self) -> bool:
        """Take the last undo back; whether there was one."""
        if not self.undone:
            return False
        self._before.append(self.session.keep())
        self._go(self.undone.pop())
        return True

    def reset(self) -> None:
        """Go to the settled tissue: an action, which can be undone."""
        self._begin()
        self._go(SETTLED)

    def set_bookmark(self) -> int:
        """Keep this moment; how many bookmarks there are now."""
        # However much later it is gone to, a replay need not compute all from here on.
        self.session.store()
        self.bookmarks.append(self.session.keep())
        self._at = 0
        self.session.note("bookmark", len(self.bookmarks))
        return len(self.bookmarks)

    def to_bookmark(self) -> int:
        """Go to the last bookmark, or the one before where this was the last way; its number, 0 where there is none."""
        if not self.bookmarks:
            return 0
        at = (self._at - 1) % len(self.bookmarks)
        self._begin()
        self._at = at
        self._go(self.bookmarks[at])
        return at + 1

    def _go(self, moment: int) -> None:
        self.session.go_back(moment)
        self._acted_s = -LONGEST_S
        self._forget()

    def _forget(self) -> None:
        needed = {*self._before, *self.undone, *self.bookmarks}
        self.session.forget(needed.__contains__)
