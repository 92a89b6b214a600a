"""Notices of what happened in a frame: undo, bookmarks, refusals, restored states, warnings of a cut."""

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import Bookmark, CutOut, Redo, Reset, Undo
from rehearsal.loop.frame import Applied, Event, Frame, Refused, Step
from rehearsal.notices import Notices
from rehearsal.resection.resection_state import NO_RESECTION, Resection
from rehearsal.resection.resection_view import warnings_of
from rehearsal.result_files import counted
from ultrasound.probe import Probe


class Announcements:
    """An ``Observer`` that posts notices."""

    def __init__(self, anatomy: DeformedAnatomy, notices: Notices) -> None:
        self.anatomy, self.notices = anatomy, notices
        self._was_paced = False
        # Of the frame before: what a reset takes away.
        self._resection = NO_RESECTION

    def observe(self, frame: Frame, probe: Probe) -> None:
        """As ``Observer.observe``."""
        for event in frame.events:
            self._announce(event, frame)
        self._resection = frame.resection
        # In the terminal once, not for each length: the panel shows the present one.
        if frame.steps and bool(frame.pace) != self._was_paced:
            self._was_paced = bool(frame.pace)
            self.notices.post(frame.pace or "Steps as they are set again.", on_screen=False)

    def _announce(self, event: Event, frame: Frame) -> None:
        match event:
            case Step() if event.notice:
                self.notices.post(event.notice)
            case Refused():
                self.notices.post(event.reason, in_terminal=not isinstance(event.command, Undo | Redo))
            case Applied(command=Undo() | Redo()):
                self.notices.post(event.command.kind, in_terminal=False)
            case Applied(command=Bookmark()):
                self.notices.post(f"Bookmark {len(frame.bookmarks)}", in_terminal=False)
            case Applied(command=Reset()):
                self.notices.post(_reset_in_words(self._resection), in_terminal=False)
            case Applied(command=CutOut()):
                number = len(frame.attempts)
                how = "{show_attempts} shows all, {next_attempt} returns to them"
                self.notices.post(f"Attempt {number} is kept: {how}", in_terminal=False)
                for warning in warnings_of(self.anatomy):
                    self.notices.post(f"Warning: {warning}")


def _reset_in_words(before: Resection) -> str:
    """What a reset takes away."""
    marks = [counted(len(before.marks), "mark")] if before.marks else []
    taken = ["tissue", "probe", *marks, *(["the cut"] if before.cut is not None else [])]
    return f"reset: {', '.join(taken[:-1])} and {taken[-1]}; {{undo}} brings them back"
