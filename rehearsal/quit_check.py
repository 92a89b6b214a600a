"""Whether a key quits at once, or has to be pressed again."""

from collections.abc import Callable
from time import perf_counter

from rehearsal.loop.frame import Frame
from rehearsal.notices import Notices

# Quitting is asked about so long after something was recorded, and the second press counts so long.
RECENT_S, AGAIN_S = 10.0, 5.0


class QuitCheck:
    """Asks once where something was recorded just now, or where there is a cut that the first frame had not.

    ``recorded_at`` gives the time of the clock [s] at which an action of the user was recorded last, None
    where none was.
    """

    def __init__(
        self, notices: Notices, frame: Frame, recorded_at: Callable[[], float | None] = lambda: None
    ) -> None:
        self._notices, self._recorded_at = notices, recorded_at
        self._cut_at_start = frame.resection.cut
        self._asked_at = -AGAIN_S

    def quits(self, frame: Frame) -> bool:
        """Whether the key that was pressed now quits; else the question is posted."""
        now = perf_counter()
        reason = self._reason(frame, now)
        if not reason or now - self._asked_at < AGAIN_S:
            return True
        self._asked_at = now
        self._notices.post(f"{{quit}} again quits; {reason}", in_terminal=False)
        return False

    def _reason(self, frame: Frame, now: float) -> str:
        if frame.resection.cut not in (None, self._cut_at_start):
            return "the cut is in the session's file, and its figures are saved when you quit"
        recorded_at = self._recorded_at()
        if recorded_at is not None and now - recorded_at < RECENT_S:
            return "the session is recorded until here"
        return ""
