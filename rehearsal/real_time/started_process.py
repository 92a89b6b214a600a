"""The solver's process, started before this program loads its libraries: the two load them at the same time.

So nothing is imported here that takes long.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

# How long the process may take to end in order.
END_S = 2.0


@dataclass(frozen=True)
class StartedProcess:
    """A process that waits for commands on a connection; None ends it."""

    process: BaseProcess
    connection: Connection

    def close(self) -> None:
        """End the process in order, so that it stores its kernels."""
        with suppress(OSError):
            self.connection.send(None)
        self.process.join(END_S)
        self.kill()

    def kill(self) -> None:
        """End the process at once, if it has not ended."""
        self.process.kill()
        self.connection.close()


def start_process() -> StartedProcess:
    """Start the process of a solver."""
    context = multiprocessing.get_context("spawn")
    connection, theirs = context.Pipe()
    process = context.Process(target=_compute, args=(theirs, os.getpid()), name="solver", daemon=True)
    with _without_interrupts():
        process.start()
    theirs.close()
    return StartedProcess(process, connection)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes that start in this context ignore Ctrl-C, which reaches them too: the one that started
    them ends them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def started_process(is_needed: bool) -> Iterator[StartedProcess | None]:
    """The process of a solver, if one is needed; at the end of this context it is killed, unless
    ``SolverProcess`` has ended it.
    """
    started = start_process() if is_needed else None
    try:
        yield started
    finally:
        if started is not None:
            started.kill()


def _compute(connection: Connection, parent: int) -> None:
    # Where processes do not inherit this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from rehearsal.real_time.solver_loop import compute

    compute(connection, parent)
