"""Messages to the user: whoever has one posts it, and the frame, or the run without a window, presents it."""

from collections.abc import Callable

from tqdm import tqdm


class Notices:
    """A queue of messages, in the order in which they were posted.

    ``{action}`` in a text stands for the key of that action.
    """

    def __init__(self) -> None:
        self._queue: list[tuple[str, bool, bool]] = []

    def post(self, text: str, on_screen: bool = True, in_terminal: bool = True) -> None:
        """Add a message; an empty text adds none."""
        if text:
            self._queue.append((text, on_screen, in_terminal))

    def present(self, worded: Callable[[str], str] = str) -> list[str]:
        """Print the messages for the terminal and return those for the screen, with the keys in words;
        empty the queue.
        """
        queue, self._queue = self._queue, []
        shown = []
        for text, on_screen, in_terminal in queue:
            if in_terminal:
                # Not beside a progress bar, on its line.
                tqdm.write(worded(text))
            if on_screen:
                shown.append(worded(text))
        return shown
