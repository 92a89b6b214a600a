"""A function in a process of its own, so that the window stays alive: its steps, its result or refusal."""

import multiprocessing
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import psutil

from errors import UserError
from rehearsal.worker_processes import end_with_parent

ENDED = (
    "the process was ended, perhaps for lack of memory; close other programs, or choose a smaller volume, "
    "and try again"
)


class BackgroundTask:
    """Runs ``function(*arguments, progress)`` of a module; ``progress`` takes the name of the next step.

    ``step`` is the present one. Once ``is_done``, ``fault`` has the words of a UserError or OSError, empty
    without one, and ``result`` what the function has returned.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe(duplex=False)
        # Not daemonic: an import has processes of its own.
        self._process = context.Process(target=_run, args=(theirs, os.getpid(), function, arguments))
        self._process.start()
        theirs.close()
        self.step, self.fault, self.is_done = "", "", False
        self.result: Any = None

    def update(self) -> None:
        """Have what the process has sent until now."""
        while not self.is_done and self._connection.poll():
            try:
                kind, content = self._connection.recv()
            except (EOFError, OSError):
                kind, content = "fault", ENDED
            if kind == "step":
                self.step = content
                continue
            self.is_done = True
            if kind == "fault":
                self.fault = content
            else:
                self.result = content

    def stop(self) -> None:
        """End the process, if it has not ended, and those that it has started."""
        # The id of one that has ended may be another's by now.
        if self._process.is_alive():
            with suppress(psutil.NoSuchProcess):
                for child in psutil.Process(self._process.pid).children(recursive=True):
                    child.kill()
            self._process.kill()
        self._process.join()
        self._connection.close()
        self.is_done = True


def _run(connection: Connection, parent: int, function: Callable[..., Any], arguments: tuple) -> None:
    # Ctrl-C reaches this process too: the one that has started it ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(parent)
    # The window may have been closed meanwhile.
    with suppress(OSError):
        try:
            result = function(*arguments, lambda step: connection.send(("step", step)))
        except UserError as error:
            connection.send(("fault", str(error)))
        except OSError as error:
            connection.send(("fault", f"{error.strerror or error}; check that it can be read and written"))
        except MemoryError:
            connection.send(("fault", "the memory is full; close other programs, or take a smaller volume"))
        else:
            connection.send(("result", result))
