"""Tasks in parallel: on processes of this machine, which end when the one that started them was killed, or on a Dask cluster."""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import psutil
from joblib import Parallel, cpu_count, delayed, parallel_config

from errors import UserError

WATCH_S = 0.5
CONNECT_S = 10
# ``map(function, tasks)``: results of function(*task) in the order of the tasks, each as soon as it is there.
Map: TypeAlias = Callable[[Callable[..., Any], Sequence[tuple]], Iterator[Any]]


class WorkerError(UserError):
    """Workers that are not available; the message is one line."""


@contextmanager
def workers(jobs: int | None = None, dask: str | None = None) -> Iterator[Map]:
    """Workers for functions of modules, with arguments that can be pickled; the results do not depend on their number.

    ``jobs`` processes on this machine, or one a processor; or those of the Dask cluster of the scheduler at an address, with this
    project in their PYTHONPATH. Raises WorkerError.
    """
    if dask is None:
        with processes(jobs):
            yield _map
        return
    try:
        from distributed import Client
    except ImportError:
        raise WorkerError(
            "--dask needs the packages dask and distributed; pip install dask distributed"
        ) from None
    try:
        client = Client(dask, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkerError(
            f"--dask {dask}: no scheduler answers there ({error}); start one, or correct it"
        ) from None
    with client:
        try:
            found = client.run(_ready)
        except Exception as error:  # any exception of a worker
            raise WorkerError(
                f"--dask {dask}: a worker is not ready ({error}); start workers with this project's requirements "
                f"installed and its folder in PYTHONPATH"
            ) from None
        if not found:
            raise WorkerError(
                f"--dask {dask}: the cluster has no workers; start some with: dask worker {dask}"
            )
        with parallel_config(backend="dask", client=client, wait_for_workers_timeout=CONNECT_S):
            yield _map


def _ready() -> bool:
    """Importable by a worker that has the project's modules."""
    return True


def _map(function: Callable[..., Any], tasks: Sequence[tuple]) -> Iterator[Any]:
    calls = (delayed(_attempt)(function, task) for task in tasks)
    for result in Parallel(batch_size=1, return_as="generator")(calls):
        if isinstance(result, Exception):
            raise result
        yield result


def _attempt(function: Callable[..., Any], task: tuple) -> Any:
    # joblib would wait forever for a task that raises on Dask.
    try:
        return function(*task)
    except Exception as error:
        return error


def end_with_parent(parent: int) -> None:
    """Initialise a worker: it ends itself soon after its parent, a process id, has ended.

    Workers of a pool whose process was killed would otherwise finish their tasks and wait for more.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def processes(jobs: int | None = None) -> parallel_config:
    """A context in which joblib uses so many processes, or one per processor, that end with this one."""
    return parallel_config(
        backend="loky", n_jobs=jobs or cpu_count(), initializer=end_with_parent, initargs=(os.getpid(),)
    )


def _watch(parent: int) -> None:
    # An orphan has another parent, or none. The id of a killed parent may still exist, until somebody waits for it.
    while (found := psutil.Process().parent()) is not None and found.pid == parent:
        time.sleep(WATCH_S)
    os._exit(1)
