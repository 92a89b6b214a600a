"""Record a rehearsal: its file, and when seconds and whole states are written to it."""

from pathlib import Path
from typing import Any

from rehearsal.notices import Notices
from rehearsal.numbered_files import next_number
from rehearsal.rehearsal import RehearsalState
from rehearsal.sessions.packed_state import to_text
from rehearsal.sessions.recorded_scene import recorded_values
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import Header, Recording
from scenes.anatomy import LoadedAnatomy, fingerprint
from version import VERSION

# Interval of whole states: a replay that opens in the middle of a session computes at most this long.
STATE_S = 60.0
NAME = r"session-([0-9]{3,9})\.jsonl"


class SessionRecorder:
    """A session with its file; ``keep_up`` after each frame."""

    def __init__(self, session: Session, recording: Recording, notices: Notices | None = None) -> None:
        self.session, self.recording = session, recording
        self.notices = notices or Notices() or Notices()
        session.recorder = recording
        self._has_warned = False
        step_s = session.rehearsal.settings.time_step_s
        self._line_every, self._state_every = max(1, round(1 / step_s)), max(1, round(STATE_S / step_s))

    def keep_up(self) -> None:
        """Write each complete second; post once what went wrong with the file."""
        session, rehearsal = self.session, self.session.rehearsal
        if self.recording.pending_steps >= self._line_every:
            self.recording.write_second(rehearsal.digest())
            if session.step_index % self._state_every < self._line_every:
                session.record_state()
        if self.recording.fault and not self._has_warned:
            self._has_warned = True
            self.notices.post(self.recording.fault, on_screen=False)

    def close(self, summary: dict[str, Any]) -> None:
        """Write the rest and the final state, from which the session can be continued."""
        rehearsal = self.session.rehearsal
        self.recording.write_second(rehearsal.digest())
        self.recording.close(summary, to_text(rehearsal.snapshot()), self.session.packed_coverage())


def record(
    session: Session,
    anatomy: LoadedAnatomy,
    arch: str,
    folder: Path,
    begins: RehearsalState | None = None,
    notices: Notices | None = None,
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
    return SessionRecorder(session, Recording(path, header), notices)
