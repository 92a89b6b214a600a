"""The messages of a session to the user: those on the screen now, and all that there were."""

from collections import deque

# How long a message stays, unless the user has read it before.
READ_S = 8.0
# What fits on the screen at the same time: lines, and letters of a line.
LINES, LETTERS = 3, 80
# So many are kept to be read again.
MOST_KEPT = 200


class MessageLog:
    """Messages wait until those before them leave room.

    ``kept`` has the time in the session [s] and the text of each, the newest last.
    """

    def __init__(self) -> None:
        self.kept: deque[tuple[float, str]] = deque(maxlen=MOST_KEPT)
        self._waiting: deque[str] = deque()
        # Text, and until when it is on the screen [s].
        self._shown: list[tuple[str, float]] = []

    def add(self, text: str, time_s: float) -> None:
        """Add a message at a time [s] in the session; one that waits or is shown already is not repeated."""
        self.kept.append((time_s, text))
        if text in self._waiting:
            return
        self._shown = [(shown, until) for shown, until in self._shown if shown != text]
        self._waiting.append(text)

    def shown(self, now_s: float) -> tuple[str, ...]:
        """The messages on the screen at a time [s] of the clock, the oldest first."""
        self._shown = [(text, until) for text, until in self._shown if now_s < until]
        while self._waiting and (not self._shown or self._fits(self._waiting[0])):
            self._shown.append((self._waiting.popleft(), now_s + READ_S))
        return tuple(text for text, _ in self._shown)

    def dismiss(self) -> None:
        """Those on the screen were read."""
        self._shown.clear()

    def _fits(self, text: str) -> bool:
        texts = [text, *(shown for shown, _ in self._shown)]
        return sum(-(-len(shown) // LETTERS) for shown in texts) <= LINES
