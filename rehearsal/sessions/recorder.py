"""Record a session in a file as it grows: an observer of frames, which writes their events."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from rehearsal.case import Case
from rehearsal.loop.frame import Applied, Checkpointed, Digest, Frame, Step
from rehearsal.loop.state import WholeState
from rehearsal.notices import Notices
from rehearsal.result_files import next_number
from rehearsal.sessions.packed_arrays import (
    SeenVoxels,
    pack_bits,
    pack_lengths,
    pack_poses,
    pack_state,
    pack_wrenches,
)
from rehearsal.sessions.session_file import (
    CommandLine,
    DigestLine,
    EndLine,
    Header,
    MovesLine,
    ReadingLine,
    StateLine,
    recorded_values,
)
from scenes.anatomy import LoadedAnatomy, fingerprint
from version import VERSION

# A second is a sum of steps: this much less counts as one.
ROUNDING_S = 1e-6
# The files of a session, and those of a resection or a page whose session is not there: none has its number
# again.
NAMES = r"(?:session|resection|report)-([0-9]{3,9})\.(?:jsonl|png|json|html)"


class SessionRecorder:
    """The file of a session. A thread writes, so that the rehearsal does not wait for the disk. ``coverage``
    returns what was imaged so far.

    Raises OSError if the file cannot be created; a later error is in ``fault`` and among the notices, and the
    rehearsal continues.
    """

    def __init__(
        self,
        path: Path,
        header: Header,
        notices: Notices,
        coverage: Callable[[], SeenVoxels | None] = lambda: None,
    ) -> None:
        self.path, self.notices, self._coverage = path, notices, coverage
        self.fault = ""
        self._has_warned = False
        self._steps: list[Step] = []
        self._usual_s = header.time_step_s
        self._file = path.open("x", encoding="utf-8")
        self._disk = ThreadPoolExecutor(1, "session")
        self._write(header)

    def observe(self, frame: Frame) -> None:
        """Write the events since the last frame; say once what went wrong with the file."""
        for event in frame.events:
            match event:
                case Step():
                    self._add(event)
                case Applied():
                    self._write_moves()
                    self._write(CommandLine(at=event.number, command=event.command))
                case Digest():
                    self._write_moves()
                    self._write(DigestLine(at=event.number, digest=event.digest))
                case Checkpointed():
                    self._write_moves()
                    seen = self._coverage()
                    self._write(StateLine(at=event.number, state=pack_state(event.state), seen=seen))
        if self.fault and not self._has_warned:
            self._has_warned = True
            self.notices.post(self.fault)

    def note(self, number: int, reading: dict[str, float | None]) -> None:
        """Write measurements in the state of a number."""
        self._write(ReadingLine(at=number, reading=reading))

    def close(self, summary: dict[str, Any]) -> None:
        """Write the rest, and wait for the disk."""
        self._write_moves()
        self._write(EndLine(summary=summary))
        self._disk.shutdown()
        try:
            self._file.close()
        except OSError as error:
            # What a full disk did not take is tried once more.
            self._fail(error)

    def _add(self, step: Step) -> None:
        self._steps.append(step)
        if sum(step.length_s for step in self._steps) > 1.0 - ROUNDING_S:
            self._write_moves()

    def _write_moves(self) -> None:
        """Write the steps since the last line."""
        steps, self._steps = self._steps, []
        if not steps:
            return
        varies = any(step.length_s != self._usual_s for step in steps)
        has_force = any(step.wrench is not None for step in steps)
        lags = any(not np.array_equal(step.pose, step.hand) for step in steps)
        presses = [step.presses for step in steps]
        self._write(
            MovesLine(
                at=steps[0].number,
                moves=pack_poses([step.hand for step in steps]),
                probe=pack_poses([step.pose for step in steps]) if lags else None,
                presses=None if all(presses) else pack_bits(presses),
                lengths_s=pack_lengths([step.length_s for step in steps]) if varies else None,
                wrenches=pack_wrenches([step.wrench for step in steps]) if has_force else None,
            )
        )

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


def header_of(
    case: Case, anatomy: LoadedAnatomy, arch: str, serial: bool, time_step_s: float, begins: WholeState | None
) -> Header:
    """The first line of a session."""
    return Header(
        version=VERSION,
        anatomy=fingerprint(anatomy),
        scene=recorded_values(case.scene),
        probe=case.probe.model_dump(mode="json", by_alias=True),
        arch=arch,
        time_step_s=time_step_s,
        serial=serial,
        begins=None if begins is None else pack_state(begins),
    )


def next_path(folder: Path) -> Path:
    """The file of the next session in a folder."""
    return folder / f"session-{next_number(folder, NAMES):03d}.jsonl"


def number_of(path: Path) -> int:
    """The number of a session's file."""
    return int(path.stem.rpartition("-")[2])
