"""What the solver's process does: it applies the commands of the other process, and between them makes the
steps that the clock asks for.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from time import perf_counter
from typing import Any

import numpy as np

import sim.device
from rehearsal.case import Case
from rehearsal.loop.command import Command, Follow, Move, NewSession, Pause
from rehearsal.loop.frame import Event, Frame
from rehearsal.loop.timeline import Timeline
from rehearsal.pressed_organ import PressedOrgan
from rehearsal.real_time.pace import MOST_WAIT_S, Pace
from rehearsal.real_time.pose_path import PosePath
from rehearsal.real_time.shared_tissue import SharedTissue
from rehearsal.worker_processes import end_with_parent
from sim.skinning import Interpolation

# Time by which the simulation may be behind the clock and still catch up; more is lost: slow motion.
MOST_BEHIND_S = 0.1
# Of a frame, what is sent apart: arrays through the shared memory, and events, of which none may be left out.
APART = "positions", "frames", "events"


@dataclass(frozen=True)
class SolverSetup:
    """What the solver is built of, and the backend; ``pace`` chooses its steps by the clock, ``serial`` is
    as for ``PressedOrgan``.
    """

    case: Case
    arch: str
    pace: Pace
    serial: bool | None = None


@dataclass(frozen=True)
class BuiltModel:
    """What the window knows of the tissue model: how points are attached to it, its sizes, and whether its
    steps are on one core.
    """

    interpolation: Interpolation
    counts: dict[str, int]
    serial: bool


@dataclass(frozen=True)
class Sent:
    """A frame without what is sent apart: the number of its arrays in the shared memory, and what has changed
    since the one before.

    ``applied`` counts the commands that were applied.
    """

    write: int
    values: dict[str, Any]
    events: tuple[Event, ...]
    applied: int


def compute(connection: Connection, parent: int) -> None:
    """Build a solver, and apply commands until None comes. The parent is a process id."""
    end_with_parent(parent)
    setup = connection.recv()
    if setup is None:
        return
    sim.device.start(setup.arch)
    organ = PressedOrgan(setup.case, setup.serial)
    connection.send(BuiltModel(organ.model.carrier.interpolation, organ.model.counts(), organ.model.serial))
    at_rest = organ.settle()
    # A step and back loads the kernels, also where the state at rest was stored. The other process is not
    # ready yet.
    organ.advance(organ.pose)
    organ.restore(at_rest)
    timeline = Timeline(organ)
    memory = _shared(connection, timeline.newest())
    if memory is not None:
        SolverLoop(connection, timeline, setup.pace, memory).serve()


def _shared(connection: Connection, frame: Frame) -> SharedTissue | None:
    """Send the first frame, and have the memory that the other process makes for the arrays of the next
    ones; None where it ends.
    """
    connection.send(frame)
    name = connection.recv()
    return None if name is None else SharedTissue(arrays_of(frame), name)


class SolverLoop:
    """Applies the commands that come, makes the steps that are due, and sends a frame after each."""

    def __init__(self, connection: Connection, timeline: Timeline, pace: Pace, memory: SharedTissue) -> None:
        self._connection, self._timeline, self._pace, self._memory = connection, timeline, pace, memory
        self._path = PosePath(np.eye(4))
        self._runs = False
        self._presses = True
        # The clock's times: up to which steps were made, and at which the newest input came.
        self._simulated_s = self._input_at_s = 0.0
        # Those of the steps that are due now.
        self._lengths_s: deque[float] = deque()
        self._writes = self._applied = 0
        self._sent: dict[str, Any] = {}

    def serve(self) -> None:
        """Serve until None comes."""
        while True:
            for command in self._commands():
                if command is None:
                    return
                self._applied += 1
                self._apply(command)
            if self._runs and perf_counter() >= self._due_s:
                self._keep_pace()

    def _commands(self) -> Iterator[Command | None]:
        """The commands that wait; if nothing else is to be done, wait for one, or until a step is due."""
        wait_s = max(self._due_s - perf_counter(), 0.0) if self._runs else None
        while self._connection.poll(wait_s):
            yield self._connection.recv()
            wait_s = 0.0

    def _apply(self, command: Command) -> None:
        if isinstance(command, Follow):
            self._follow(command)
            return
        if isinstance(command, Pause | Move | NewSession):
            self._runs = False
        self._timeline.submit(command)
        frame = self._timeline.newest()
        if self._runs and frame.restored:
            # The hand has not moved since.
            self._path.stay(frame.pose, perf_counter())
        self._send(frame)

    def _follow(self, command: Follow) -> None:
        """Keep pace with the clock from now on, and move the transducer to where the hand has it."""
        if not self._runs:
            self._runs, self._simulated_s = True, perf_counter()
            self._path.stay(self._timeline.organ.pose, self._simulated_s)
            self._lengths_s.clear()
        self._timeline.aim(command)
        self._path.go_to(command.pose, command.input_s, command.took_s)
        self._presses = command.presses
        self._input_at_s = perf_counter()

    @property
    def _due_s(self) -> float:
        """The clock's time at which the next step is due: at its end, so that it follows the input."""
        if self._lengths_s:
            return self._simulated_s
        at_end_s = self._simulated_s + self._pace.length_s
        if not self._pace.waits_for_input:
            return at_end_s
        return max(at_end_s, self._input_at_s if self._path.has_news else self._simulated_s + MOST_WAIT_S)

    def _keep_pace(self) -> None:
        pace, full = self._pace, self._timeline.organ.settings.iterations
        late_s = 0.0
        if not self._lengths_s:
            late_s = perf_counter() - self._due_s
            self._plan_steps()
        length_s, text = self._lengths_s.popleft(), pace.text(full)
        self._simulated_s += length_s
        hand = self._path.pose_after(length_s)
        clock = self._path.input_s, 1000 * late_s, pace.waits_for_input
        step = self._timeline.step(hand, length_s, pace.iterations(full), *clock, self._presses)
        self._send(replace(self._timeline.newest(), pace=text))
        pace.note(step.took_ms, length_s)

    def _plan_steps(self) -> None:
        """Choose the lengths of the steps that are due now."""
        behind_s = perf_counter() - self._simulated_s
        most_s = MOST_BEHIND_S + self._pace.length_s
        self._simulated_s += max(behind_s - most_s, 0.0)
        self._lengths_s += self._pace.lengths_s(min(behind_s, most_s))
        if self._pace.waits_for_input:
            self._path.arrive_in(sum(self._lengths_s))

    def _send(self, frame: Frame) -> None:
        """Write a frame's arrays, then send the rest of it that is not as in the last one."""
        self._writes += 1
        self._memory.write(arrays_of(frame), self._writes)
        values = {name: value for name, value in vars(frame).items() if name not in APART}
        news = {name: value for name, value in values.items() if self._sent.get(name) is not value}
        self._sent = values
        self._connection.send(Sent(self._writes, news, frame.events, self._applied))


def arrays_of(frame: Frame) -> list[np.ndarray]:
    """What is in the shared memory."""
    return [frame.positions] if frame.frames is None else [frame.positions, frame.frames]
