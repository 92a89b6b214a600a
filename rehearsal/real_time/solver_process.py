"""The solver in a process of its own, which keeps pace with the clock while this process makes pictures.

The rehearsal of this process is a copy: ``collect`` sets it to the newest state. Whatever else changes the tissue, such as an undo, is
done to the copy while the solver is paused, and ``hand_over`` gives it to the solver.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from errors import UserError
from rehearsal.pressed_organ import OrganState, Step
from rehearsal.real_time.shared_state import SharedState
from rehearsal.real_time.solver_loop import PAUSED, SolverSetup
from rehearsal.real_time.started_process import END_S, StartedProcess
from rehearsal.rehearsal import Rehearsal
from rehearsal.resection.cut import Cut

# How long a picture waits for the step that shows its input.
MOST_WAIT_S = 0.1


class SolverEnded(UserError):
    """The process has ended by itself."""


class SolverProcess:
    """Talks with the process; ``build`` gives it an organ, ``settled`` waits for it at rest, ``attach`` names the rehearsal that copies it.

    ``on_step`` is called with each step that is collected. ``pending`` counts the steps of ``play`` that were not collected yet.
    Every method may raise SolverEnded.
    """

    def __init__(self, started: StartedProcess) -> None:
        self._started, self._connection = started, started.connection
        self._memory: SharedState | None = None
        self.on_step: Callable[[Step], None] = lambda step: None
        self.is_paused = True
        self.pending = 0
        self._received = 0
        self._uncollected: deque[Step] = deque()
        # The times of the input before the newest and of the newest, and the last step that was received.
        self._inputs_s = 0.0, 0.0
        self._last_step: Step | None = None
        # The cut that the process has.
        self._cut: Cut | None = None

    def build(self, setup: SolverSetup) -> None:
        """Build the solver of a scene."""
        own = getattr(setup.scene.tissue, "parts", {})
        parts = {tissue: part for tissue, part in setup.anatomy.parts.items() if tissue in own}
        self._send("build", replace(setup, anatomy=replace(setup.anatomy, ct=None, labels=None, parts=parts)))

    def settled(self) -> OrganState:
        """Return the organ at rest, as soon as it is known."""
        return self._receive()

    def attach(self, rehearsal: Rehearsal) -> None:
        """Copy the states to a rehearsal from now on; it is at rest."""
        self.rehearsal = rehearsal
        if self._memory is not None:
            self._memory.close()
        self._memory = SharedState(rehearsal.snapshot_of_organ())
        self._send("share", self._memory.name)

    def collect(self) -> None:
        """Set the rehearsal to the newest state: where steps wait for the input, to one that shows the newest input."""
        until_s = perf_counter() + MOST_WAIT_S
        while self._connection.poll(max(until_s - perf_counter(), 0.0) if self._awaits_step else 0.0):
            self._receive_step()
        self._take()

    def pause(self) -> None:
        """Wait for the end of the steps that are being made; then as ``collect``."""
        if not self.is_paused:
            self._send("pause")
            while self._receive_step():
                pass
            self.is_paused = True
        self._take()
        while self.pending:
            self._receive_step()
            self._take()

    def hand_over(self) -> None:
        """Give the rehearsal's state and settings to the paused solver."""
        rehearsal = self.rehearsal
        if rehearsal.cut is not self._cut:
            self._cut = rehearsal.cut
            self._send("apply_cut", self._cut)
        self._send("take_over", rehearsal.snapshot_of_organ(), rehearsal.settings, rehearsal.young_kpa)

    def run(self) -> None:
        """Keep pace with the clock from now on."""
        self._send("run")
        self.is_paused = False

    def go_to(self, pose: np.ndarray, input_s: float, took_s: float) -> None:
        """Move the transducer to a pose (4, 4) that the input had at a time [s] (``perf_counter``), a time [s] after the last one."""
        self._send("go_to", pose, input_s, took_s)
        self._inputs_s = self._inputs_s[1], input_s

    def play(self, poses: np.ndarray, lengths_s: np.ndarray) -> None:
        """Make steps to these poses (n, 4, 4), of these lengths (n,) [s], at once; the solver stays paused."""
        self.pending += len(poses)
        self._send("play", poses, lengths_s)

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
        return not self.is_paused and last is not None and last.awaited and last.input_s <= self._inputs_s[0]

    def _receive_step(self) -> bool:
        """Receive a step; return whether it was one, and not the answer to a pause."""
        message = self._receive()
        if message == PAUSED:
            return False
        self._last_step = message
        self._uncollected.append(message)
        self._received += 1
        return True

    def _take(self) -> None:
        """Set the rehearsal to the newest state, and hand on the steps up to it."""
        if self._memory is None or not self._uncollected:
            return
        # A state is written before its step is sent. If newer ones have taken its place, their steps are on the way.
        while (state := self._memory.read(self._received)) is None:
            self._receive_step()
        self.rehearsal.restore_organ(state)
        self.pending = max(0, self.pending - len(self._uncollected))
        while self._uncollected:
            self.on_step(self._uncollected.popleft())

    def _send(self, request: str, *values: Any) -> None:
        try:
            self._connection.send((request, values))
        except OSError:
            raise self._ended() from None

    def _receive(self) -> Any:
        try:
            return self._connection.recv()
        except (EOFError, OSError):
            raise self._ended() from None

    def _ended(self) -> SolverEnded:
        process = self._started.process
        process.join(END_S)
        return SolverEnded(
            f"the solver's process has ended (exit status {process.exitcode}), perhaps for lack of memory; what was recorded "
            "until then can be replayed: close other programs and start again"
        )
