"""A rehearsal that is recorded: its file, and when lines and whole states go to it."""

from pathlib import Path
from typing import Any

from rehearsal.numbered_files import next_number
from rehearsal.rehearsal import RehearsalState
from rehearsal.sessions.packed_state import to_text
from rehearsal.sessions.recorded_scene import recorded_values
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import Header, Recording
from scenes.anatomy import LoadedAnatomy, fingerprint
from version import VERSION

# A whole state is written so often: from one to the next, at most, is computed anew where a session is opened in its midst.
STATE_S = 60.0
NAME = r"session-([0-9]{3,9})\.jsonl"


class SessionRecorder:
    """A session with its file; ``watch`` after each moment."""

    def __init__(self, session: Session, recording: Recording) -> None:
        self.session = session
        self.recording = recording
        session.recorder = recording
        self._has_told = False
        step_s = session.rehearsal.settings.time_step_s
        self._line_every, self._state_every = max(1, round(1 / step_s)), max(1, round(STATE_S / step_s))

    def watch(self) -> str:
        """Write the line of a second that is over; what went wrong with the file, once."""
        session, rehearsal = self.session, self.session.rehearsal
        if self.recording.moments >= self._line_every:
            self.recording.line(rehearsal.digest())
            if session.moment % self._state_every < self._line_every:
                session.store()
        news = "" if self._has_told else self.recording.fault
        self._has_told = bool(self.recording.fault)
        return news

    def close(self, summary: dict[str, Any]) -> None:
        """Write what is left, with the state, from which the session can go on another day."""
        rehearsal = self.session.rehearsal
        self.recording.line(rehearsal.digest())
        self.recording.close(summary, to_text(rehearsal.snapshot()), self.session.seen())


def record(
    session: Session,
    anatomy: LoadedAnatomy,
    arch: str,
    folder: Path,
    begins: RehearsalState | None = None,
) -> SessionRecorder:
    """Record a session from here on under the next free number of a folder. Raises OSError."""
    rehearsal = session.rehearsal
    header = Header(
        version=VERSION,
        anatomy=fingerprint(anatomy),
        scene=recorded_values(rehearsal.scene),
        probe=rehearsal.probe.model_dump(mode="json", by_alias=True),
        arch=arch,
        time_step_s=rehearsal.settings.time_step_s,
        begins=None if begins is None else to_text(begins),
    )
    path = folder / f"session-{next_number(folder, NAME):03d}.jsonl"
    return SessionRecorder(session, Recording(path, header))
