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
from rehearsal.sessions.packed_arrays import pack_lengths, pack_poses, pack_state, pack_wrenches
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import End, Event, Header, Kind, Second, recorded_values
from scenes.anatomy import LoadedAnatomy, fingerprint
from version import VERSION

# Interval of whole states: a replay that opens in the middle of a session computes at most this long.
STATE_S = 60.0
# A second is a sum of steps: this much less counts as one.
ROUNDING_S = 1e-6
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
        self._lengths_s: list[float] = []
        self._wrenches: list[np.ndarray | None] = []
        self._usual_s = header.time_step_s
        self._state_due_s = STATE_S
        self._events: list[Event] = []
        self._file = path.open("x", encoding="utf-8")
        self._disk = ThreadPoolExecutor(1, "session")
        self._write(header)
        session.recorder = self

    def note(self, kind: Kind, value: Any) -> None:
        """Note something about the coming step."""
        self._events.append(Event(at=self.session.step_index, kind=kind, value=value))

    def add_step(self, pose: np.ndarray | None, length_s: float, wrench: np.ndarray | None = None) -> None:
        """Add a step by its pose (4, 4), or a rollback by None, its length [s] and the wrench (6,) on the probe."""
        self._poses.append(pose)
        self._lengths_s.append(length_s)
        self._wrenches.append(wrench)

    @property
    def is_state_due(self) -> bool:
        """Whether ``keep_up`` will record the whole state."""
        return self._is_second_over and self.session.time_s > self._state_due_s - ROUNDING_S

    @property
    def _is_second_over(self) -> bool:
        return sum(self._lengths_s) > 1.0 - ROUNDING_S

    def keep_up(self, may_record_state: bool = True) -> None:
        """Write each complete second, and with it the whole state if that is due; post once what went wrong with the file.

        Where the state may not be recorded now, a second with it waits.
        """
        records_state = self.is_state_due
        if self._is_second_over and (may_record_state or not records_state):
            self._write_second()
            if records_state:
                self._state_due_s += STATE_S
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
            varies = any(length_s != self._usual_s for length_s in self._lengths_s)
            lengths_s = pack_lengths(self._lengths_s) if varies else None
            poses, events = pack_poses(self._poses), self._events
            has_force = any(wrench is not None for wrench in self._wrenches)
            wrenches = pack_wrenches(self._wrenches) if has_force else None
            self._write(
                Second(
                    at=at, poses=poses, lengths_s=lengths_s, wrenches=wrenches, events=events, digest=digest
                )
            )
            self._poses, self._lengths_s, self._wrenches, self._events = [], [], [], []

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
        serial=rehearsal.model.serial,
        begins=None if begins is None else pack_state(begins),
    )
    path = folder / f"session-{next_number(folder, NAME):03d}.jsonl"
    return SessionRecorder(session, path, header, notices)
