"""Record a session in a file as it grows: each second its steps, once a minute the whole state."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from rehearsal.notices import Notices
from rehearsal.rehearsal import RehearsalState
from rehearsal.result_files import next_number
from rehearsal.sessions.packed_arrays import pack_poses, pack_state
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import End, Event, Header, Kind, Second, recorded_values
from scenes.anatomy import LoadedAnatomy, fingerprint
from version import VERSION

# Interval of whole states: a replay that opens in the middle of a session computes at most this long.
STATE_S = 60.0
NAME = r"session-([0-9]{3,9})\.jsonl"


class SessionRecorder:
    """The file of a session; ``keep_up`` after each frame. A thread writes, so that the rehearsal does not wait for the disk.

    Raises OSError if the file cannot be created; a later error is in ``fault`` and among the notices, and the rehearsal continues.
    """

    def __init__(self, session: Session, path: Path, header: Header, notices: Notices | None = None) -> None:
        self.session, self.path = session, path
        self.notices = notices or Notices()
        self.fault = ""
        self._has_warned = False
        self._poses: list[np.ndarray | None] = []
        self._events: list[Event] = []
        step_s = session.rehearsal.settings.time_step_s
        self._line_every, self._state_every = max(1, round(1 / step_s)), max(1, round(STATE_S / step_s))
        self._file = path.open("x", encoding="utf-8")
        self._disk = ThreadPoolExecutor(1, "session")
        self._write(header)
        session.recorder = self

    def note(self, kind: Kind, value: Any) -> None:
        """Note something about the coming step."""
        self._events.append(Event(at=self.session.step_index, kind=kind, value=value))

    def add_step(self, pose: np.ndarray | None) -> None:
        """Add a step by its pose (4, 4), or a rollback by None."""
        self._poses.append(pose)

    def keep_up(self) -> None:
        """Write each complete second; post once what went wrong with the file."""
        if len(self._poses) >= self._line_every:
            self._write_second()
            if self.session.step_index % self._state_every < self._line_every:
                self.session.record_state()
        if self.fault and not self._has_warned:
            self._has_warned = True
            self.notices.post(self.fault, on_screen=False)

    def close(self, summary: dict[str, Any]) -> None:
        """Write the rest and the final state, from which the session can be continued, and wait for the disk."""
        self._write_second()
        state, seen = pack_state(self.session.rehearsal.snapshot()), self.session.packed_coverage()
        self._write(End(summary=summary, state=state, seen=seen))
        self._disk.shutdown()
        try:
            self._file.close()
        except OSError as error:
            # What a full disk did not take is tried once more.
            self._fail(error)

    def _write_second(self) -> None:
        """Write the steps since the last line, with the tissue's present digest."""
        if self._poses:
            at, digest = self.session.step_index - len(self._poses), self.session.rehearsal.digest()
            self._write(Second(at=at, poses=pack_poses(self._poses), events=self._events, digest=digest))
            self._poses, self._events = [], []

    def _write(self, line: BaseModel) -> None:
        self._disk.submit(self._put, line)

    def _put(self, line: BaseModel) -> None:
        """On the disk's own thread; after a fault nothing more, or a line would be missing in between."""
        if self.fault:
            return
        try:
            self._file.write(line.model_dump_json(exclude_none=True) + "\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except (OSError, ValueError) as error:
            self._fail(error)

    def _fail(self, error: OSError | ValueError) -> None:
        if not self.fault:
            self.fault = f"{self.path.name}: no longer written ({getattr(error, 'strerror', None) or error})"


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
        begins=None if begins is None else pack_state(begins),
    )
    path = folder / f"session-{next_number(folder, NAME):03d}.jsonl"
    return SessionRecorder(session, path, header, notices)
