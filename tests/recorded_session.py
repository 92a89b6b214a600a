"""A session of a fake organ, recorded by a user who does all there is to do."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from fake_organ import STEP_S, fake_timeline, pose_at

from rehearsal.loop.command import (
    BeginAction,
    Bookmark,
    Checkpoint,
    Mark,
    Move,
    NewSession,
    Redo,
    SetValues,
    Undo,
)
from rehearsal.notices import Notices
from rehearsal.sessions.packed_arrays import SeenVoxels
from rehearsal.sessions.recorder import SessionRecorder
from rehearsal.sessions.session_file import Header


def header() -> Header:
    """Of no patient."""
    return Header(anatomy="0", scene={}, probe={}, arch="x64", time_step_s=STEP_S)


class LiveSession:
    """A stepper whose frames are recorded in a file."""

    def __init__(
        self,
        path: Path,
        seen: Callable[[], SeenVoxels | None] = lambda: None,
        header: Header | None = None,
    ) -> None:
        self.stepper, self.notices = fake_timeline(), Notices()
        self.stepper.submit(NewSession(pose=np.eye(4)))
        self.recorder = SessionRecorder(path, header or globals()["header"](), self.notices, seen)

    def do(self, *commands) -> None:
        """Apply commands, and record the frame after them."""
        for command in commands:
            self.stepper.submit(command)
        self.recorder.observe(self.stepper.newest())

    def move(self, count: int) -> str:
        """Make so many steps; the digest after them."""
        for number in range(count):
            self.do(Move(pose=pose_at(number % 7 - 3.0)))
        return self.stepper.organ.digest()

    def on_disk(self) -> None:
        """Wait until the disk has all that was handed to it."""
        self.recorder._disk.submit(int).result(10)


def record_all(path: Path, steps: int = 40, **given) -> str:
    """A session with each kind of command; the tissue's digest at its end."""
    live = LiveSession(path, **given)
    live.do(SetValues(values={"tissue.young_kpa": 20.0, "probe.depth_mm": 50.0}))
    live.move(steps // 4)
    live.do(BeginAction(), Bookmark())
    live.move(steps // 4)
    live.do(Undo(), Redo(), Mark(places_mm=[(1.0, 2.0, 3.0)]))
    digest = live.move(steps // 2)
    live.do(Checkpoint())
    live.recorder.note(7, {"force_n": 1.5, "margin_mm": None})
    live.recorder.close({"presses": 1})
    return digest
