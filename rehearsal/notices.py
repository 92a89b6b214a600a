"""Messages to the user: whoever has one posts it, and the frame, or the run without a window, presents it."""

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class Notice:
    """One message. ``{action}`` in its text stands for the key of that action."""

    text: str
    on_screen: bool
    in_terminal: bool


class Notices:
    """A queue of messages, in the order in which they were posted."""

    def __init__(self) -> None:
        self._queue: deque[Notice] = deque()

    def post(self, text: str, on_screen: bool = True, in_terminal: bool = True) -> None:
        """Add a message; an empty text adds none."""
        if text:
            self._queue.append(Notice(text, on_screen, in_terminal))

    def take(self) -> list[Notice]:
        """Return the messages since the last call, and empty the queue."""
        taken = list(self._queue)
        self._queue.clear()
        return taken
