"""The whole state of a rehearsal, and which states undo, redo and bookmarks restore.

``Timeline`` keeps the states themselves.
"""

from dataclasses import dataclass, replace

from rehearsal.pressed_organ import OrganState
from rehearsal.resection.resection_state import NO_RESECTION, Resection
from ultrasound.probe_manipulator import ManipulatorState

MOST_UNDONE = 40


@dataclass(frozen=True)
class WholeState:
    """All that commands change; steps from it give the same bits as before.

    ``manipulator`` is None where no hand has moved it.
    """

    organ: OrganState
    resection: Resection = NO_RESECTION
    manipulator: ManipulatorState | None = None


@dataclass(frozen=True)
class History:
    """Undo, redo and bookmarks as a value.

    Numbers of states: ``before`` each action that can be undone, those that were ``undone``, ``bookmarks``,
    and right after each cut (``attempts``), the newest last.
    """

    before: tuple[int, ...] = ()
    undone: tuple[int, ...] = ()
    bookmarks: tuple[int, ...] = ()
    attempts: tuple[int, ...] = ()

    @property
    def numbers(self) -> frozenset[int]:
        """All states that may be restored."""
        return frozenset((*self.before, *self.undone, *self.marked_states))

    @property
    def marked_states(self) -> tuple[int, ...]:
        """Bookmarks and attempts: what ``GoTo`` may restore."""
        return (*self.bookmarks, *self.attempts)

    def begun(self, now: int) -> "History":
        """After an action began in a state: what was undone before it cannot be redone."""
        return replace(self, before=(*self.before, now)[-MOST_UNDONE:], undone=())

    def undo(self, now: int) -> tuple["History", int | None]:
        """The history after an undo in a state, and the state to restore; None where there is nothing to
        undo.
        """
        if not self.before:
            return self, None
        return replace(self, before=self.before[:-1], undone=(*self.undone, now)), self.before[-1]

    def redo(self, now: int) -> tuple["History", int | None]:
        """The history after a redo in a state, and the state to restore; None where there is nothing to
        redo.
        """
        if not self.undone:
            return self, None
        before = (*self.before, now)[-MOST_UNDONE:]
        return replace(self, before=before, undone=self.undone[:-1]), self.undone[-1]

    def marked(self, now: int) -> "History":
        """With a bookmark of a state."""
        return replace(self, bookmarks=(*self.bookmarks, now))

    def attempted(self, now: int) -> "History":
        """With an attempt: the state right after a cut."""
        return replace(self, attempts=(*self.attempts, now))
