"""Each backend's cases in a process of its own, so that a driver that crashes or hangs ends that process
alone.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from time import monotonic

from rehearsal.worker_processes import end_with_parent
from sim.device import NoDevice, start
from studies.gpu.device_cases import Case, CaseFigures, cases

END_S = 5.0
CasesOf = Callable[[str], dict[str, Case]]


@dataclass
class BackendRun:
    """What was measured on a backend, and by case what was not and why; ``reason``: why it ended before
    the last of them; ``ended``: how many did.
    """

    backend: str
    measured: list[CaseFigures] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    reason: str = ""
    ended: int = 0


def run_backend(
    backend: str, seconds: float, tries_refused: bool, cases_of: CasesOf = cases
) -> Iterator[BackendRun]:
    """Measure on a backend for so long, one case after the other; the run so far after each of them."""
    run, names = BackendRun(backend), list(cases_of(backend))
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    arguments = theirs, backend, tries_refused, cases_of, os.getpid()
    child = context.Process(target=_measure, args=arguments, daemon=True)
    end_s = monotonic() + seconds
    child.start()
    theirs.close()
    try:
        while names and not run.reason and ours.poll(max(end_s - monotonic(), 0.0)):
            kind, value = ours.recv()
            if kind == "measured":
                run.measured.append(value)
            elif kind == "refused":
                run.reason = value
            else:
                name = names.pop(0)
                run.ended += 1
                if value:
                    run.missing[name] = value
            yield run
        run.reason = run.reason or f"no time left of the {seconds:.0f} s for this backend"
    except EOFError:
        child.join(END_S)
        run.reason = f"the process ended by itself (exit code {child.exitcode})"
    finally:
        child.kill()
    run.missing |= dict.fromkeys(names, run.reason)
    yield run


def _measure(
    connection: Connection, backend: str, tries_refused: bool, cases_of: CasesOf, parent: int
) -> None:
    """In the process: send ("measured", CaseFigures), ("ended", fault or "") of a case, ("refused", why)."""
    end_with_parent(parent)
    try:
        start(backend, accepts_wrong_results=tries_refused)
    except NoDevice as error:
        connection.send(("refused", str(error)))
        return
    for case in cases_of(backend).values():
        fault = ""
        try:
            for measured in case():
                connection.send(("measured", measured))
        # Whatever a driver does: the cases after it are measured, and the fault stands in the table.
        except Exception as error:
            first_line = (str(error).strip() or "no message").splitlines()[0]
            fault = f"{type(error).__name__}: {first_line}"
        connection.send(("ended", fault))
