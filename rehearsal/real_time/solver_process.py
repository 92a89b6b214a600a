"""The solver in a process of its own, which keeps pace with the clock while this process makes pictures: a
``Stepper``.
"""

from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np

from errors import UserError
from rehearsal.loop.command import Command, Follow, Move, NewSession, Pause
from rehearsal.loop.frame import Event, Frame, Step
from rehearsal.real_time.shared_tissue import SharedTissue
from rehearsal.real_time.solver_loop import APART, BuiltModel, Sent, SolverSetup, arrays_of
from rehearsal.real_time.started_process import END_S, StartedProcess

# How often the window shows progress while it waits for the solver.
WAIT_S = 0.1


class SolverEnded(UserError):
    """The process has ended by itself."""


class SolverProcess:
    """A ``Stepper`` in another process: ``build`` gives it a case; ``model`` and then ``begin`` wait for it,
    and meanwhile call what they are given, several times a second.

    Every method may raise SolverEnded.
    """

    def __init__(self, started: StartedProcess) -> None:
        self._started, self._connection = started, started.connection
        self._memory: SharedTissue | None = None
        self._values: dict[str, Any] = {}
        self._events: list[Event] = []
        self._write = self._submitted = self._applied = 0
        # The times of the input before the newest and of the newest, and the last step that was received.
        self._inputs_s = 0.0, 0.0
        self._last_step: Step | None = None
        self._runs = False

    def build(self, setup: SolverSetup) -> None:
        """Build the solver of a case."""
        self._send(setup)

    def model(self, wait: Callable[[], None] = lambda: None) -> BuiltModel:
        """What the window knows of the tissue model, as soon as it is built."""
        return self._awaited(wait)

    def begin(self, wait: Callable[[], None] = lambda: None) -> None:
        """Wait for the organ at rest."""
        frame: Frame = self._awaited(wait)
        self._memory = SharedTissue(arrays_of(frame))
        self._memory.write(arrays_of(frame), 0)
        self._send(self._memory.name)
        self._values = {name: value for name, value in vars(frame).items() if name not in APART}

    def submit(self, command: Command) -> None:
        """As ``Stepper.submit``."""
        if isinstance(command, Follow):
            self._runs, self._inputs_s = True, (self._inputs_s[1], command.input_s)
        elif isinstance(command, Pause | Move | NewSession):
            if isinstance(command, Pause) and not self._runs:
                return
            self._runs = False
        self._submitted += 1
        self._send(command)

    def newest(self, wait_s: float = 0.0) -> Frame:
        """As ``Stepper.newest``: where steps wait for the input, one that shows the newest input."""
        until_s = perf_counter() + wait_s
        while self._connection.poll(max(until_s - perf_counter(), 0.0) if self._awaits_step else 0.0):
            self._receive_frame()
        return self._frame()

    def wait(self, most_s: float = np.inf) -> None:
        """As ``Stepper.wait``."""
        until_s = perf_counter() + most_s
        while self._applied < self._submitted:
            left_s = None if most_s == np.inf else max(until_s - perf_counter(), 0.0)
            if not self._connection.poll(left_s):
                return
            self._receive_frame()

    def close(self) -> None:
        """End the process."""
        self._started.close()
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    @property
    def _awaits_step(self) -> bool:
        """Whether steps wait for the input, and none towards the newest one was received."""
        last = self._last_step
        return self._runs and last is not None and last.awaited and last.input_s <= self._inputs_s[0]

    def _frame(self) -> Frame:
        if self._memory is None:
            raise RuntimeError("the solver has not begun")
        # Arrays are written before the rest is sent. If newer ones have taken their place, the rest of these
        # is on the way.
        while (arrays := self._memory.read(self._write)) is None:
            self._receive_frame()
        events, self._events = tuple(self._events), []
        frames = arrays[1] if len(arrays) > 1 else None
        return Frame(**self._values, positions=arrays[0], frames=frames, events=events)

    def _receive_frame(self) -> None:
        sent: Sent = self._receive()
        self._write, self._applied = sent.write, sent.applied
        self._events += sent.events
        self._values |= sent.values
        steps = [event for event in sent.events if isinstance(event, Step)]
        self._last_step = steps[-1] if steps else self._last_step

    def _send(self, message: Any) -> None:
        try:
            self._connection.send(message)
        except OSError:
            raise self._ended() from None

    def _awaited(self, wait: Callable[[], None]) -> Any:
        while not self._connection.poll(WAIT_S):
            wait()
        return self._receive()

    def _receive(self) -> Any:
        try:
            return self._connection.recv()
        except (EOFError, OSError):
            raise self._ended() from None

    def _ended(self) -> SolverEnded:
        process = self._started.process
        process.join(END_S)
        return SolverEnded(
            f"the solver's process has ended (exit status {process.exitcode}), perhaps for lack of memory; "
            "what was recorded "
            "until then can be replayed: close other programs and start again"
        )
