"""Whether the key to quit does so at once, or has to be pressed again."""

from collections.abc import Callable
from time import perf_counter

from rehearsal.loop.frame import Frame
from rehearsal.notices import Notices
from rehearsal.result_files import counted

# An action asks for a second press so long, and the second press counts so long.
RECENT_S, AGAIN_S = 10.0, 5.0


class QuitCheck:
    """Asks once after an action of the user, and where a cut was made.

    ``acted_at`` gives the time of the clock [s] of the last action; None where there was none, as in a
    replay.
    """

    def __init__(self, notices: Notices, acted_at: Callable[[], float | None] = lambda: None) -> None:
        self._notices, self._acted_at = notices, acted_at
        self._asked_at: float | None = None

    def quits(self, frame: Frame) -> bool:
        """Whether the key that was pressed now quits; else a notice says why not."""
        now = perf_counter()
        reason = self._reason(frame, now)
        if not reason or (self._asked_at is not None and now - self._asked_at < AGAIN_S):
            return True
        self._asked_at = now
        self._notices.post(f"{{quit}} again quits; {reason}", in_terminal=False)
        return False

    def _reason(self, frame: Frame, now: float) -> str:
        acted_at = self._acted_at()
        if acted_at is None:
            return ""
        if frame.attempts:
            return f"this session has {counted(len(frame.attempts), 'cut')}"
        return f"the last action is less than {RECENT_S:.0f} s old" if now - acted_at < RECENT_S else ""
