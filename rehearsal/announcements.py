"""Notices of what happened in a frame: undo, bookmarks, refusals, restored states, warnings of a cut."""

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import Bookmark, CutOut, Redo, Undo
from rehearsal.loop.frame import Applied, Event, Frame, Refused, Step
from rehearsal.notices import Notices
from rehearsal.resection.resection_view import warnings_of
from ultrasound.probe import Probe


class Announcements:
    """An ``Observer`` that posts notices."""

    def __init__(self, anatomy: DeformedAnatomy, notices: Notices) -> None:
        self.anatomy, self.notices = anatomy, notices
        self._was_paced = False

    def observe(self, frame: Frame, probe: Probe) -> None:
        """As ``Observer.observe``."""
        for event in frame.events:
            self._announce(event, frame)
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
            case Applied(command=CutOut()):
                for warning in warnings_of(self.anatomy):
                    self.notices.post(f"Warning: {warning}")
