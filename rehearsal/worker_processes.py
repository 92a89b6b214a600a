"""Tasks in parallel: on processes of this machine, which end when the one that started them was killed, or
on a Dask cluster.
"""

import os
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from typing import Any, Self, TypeVar

import psutil
from joblib import cpu_count
from joblib.externals.loky import ProcessPoolExecutor, process_executor

import sim.device
from errors import UserError

WATCH_S = 0.5
CONNECT_S = 10
# What a future raises whose worker has ended.
ENDED = (BrokenExecutor, process_executor.ShutdownExecutorError, CancelledError)
T = TypeVar("T")


class WorkerError(UserError):
    """Workers that are not available, or no longer; the message is one line."""


class Workers:
    """Workers for functions of modules, with arguments that can be pickled; a context manager.

    They are ``jobs`` processes on this machine, or one a processor; or those of the Dask cluster of the
    scheduler at an address, with this project in the PYTHONPATH of all. Even a single process is another one
    than this, where Taichi may be in use. ``count`` is their number. Raises WorkerError.
    """

    def __init__(self, jobs: int | None = None, dask: str | None = None) -> None:
        self._client: Any = None
        if dask is None:
            self.count = jobs or cpu_count()
            self._executor: Executor = ProcessPoolExecutor(
                self.count, initializer=_begin, initargs=(os.getpid(),)
            )
        else:
            self._client, self.count = _connect(dask)
            self._executor = self._client.get_executor(pure=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def map(self, function: Callable[..., T], tasks: Iterable[tuple]) -> Iterator[T]:
        """The results of ``function(*task)`` in the order of the tasks, which do not depend on the number of
        workers.

        Raises what the function raises, and WorkerError where a worker has ended.
        """
        done: dict[int, Future] = {}
        due = 0
        for number, future in self.completed(function, tasks):
            done[number] = future
            while due in done:
                future = done.pop(due)
                if has_ended(error_of(future)):
                    raise WorkerError(
                        "a worker process was ended, perhaps for lack of memory; close other programs, or "
                        "give fewer --jobs"
                    )
                yield future.result()
                due += 1

    def completed(self, function: Callable[..., T], tasks: Iterable[tuple]) -> Iterator[tuple[int, Future]]:
        """The number of each task and its future, as soon as it has ended.

        Tasks are taken as there is a worker for them soon.
        """
        left, running = enumerate(tasks), dict[Future, int]()
        # With more tasks queued than its processes soon take, loky's own thread fails when it is stopped.
        most, is_more = 2 * self.count, True
        while is_more or running:
            # What has ended meanwhile comes before the next task, which may take long to make.
            while is_more and len(running) < most and not any(future.done() for future in running):
                number, task = next(left, (0, None))
                is_more = task is not None
                if task is not None:
                    running[self._submit(function, task)] = number
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in sorted(ended, key=running.__getitem__):
                yield running.pop(future), future

    def _submit(self, function: Callable[..., Any], task: tuple) -> Future:
        try:
            if self._client is not None:
                return self._executor.submit(_in_one_thread, function, *task)
            return self._executor.submit(function, *task)
        except (*ENDED, RuntimeError):
            refused: Future = Future()
            refused.set_exception(BrokenExecutor())
            return refused

    def share(self, value: T) -> T:
        """A large argument of many tasks, sent once to each worker of a cluster.

        It must be an argument of its own.
        """
        return value if self._client is None else self._client.scatter(value, broadcast=True)

    def stop(self) -> None:
        """End the tasks, and the processes of this machine; a thread that waits for them gets a
        WorkerError.
        """
        if self._client is None:
            self._executor.shutdown(wait=False, kill_workers=True)  # type: ignore[call-arg]
        else:
            self._executor.shutdown(wait=False)
            self._client.close()


def _connect(dask: str) -> tuple[Any, int]:
    """A client of the cluster at an address, and the number of its workers. Raises WorkerError."""
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
    try:
        # The scheduler unpickles tasks too.
        client.run_on_scheduler(_ready)
        ready = client.run(_ready)
    except Exception as error:  # any exception of scheduler or worker
        client.close()
        raise WorkerError(
            f"--dask {dask}: scheduler or worker is not ready ({error}); start both with this project's "
            "requirements "
            f"installed and its folder in PYTHONPATH"
        ) from None
    if not ready:
        client.close()
        raise WorkerError(f"--dask {dask}: the cluster has no workers; start some with: dask worker {dask}")
    return client, len(ready)


def _ready() -> bool:
    """Importable by a worker that has the project's modules."""
    return True


# A Dask worker may run several threads; Taichi serves the one that has started it.
_one_thread = ThreadPoolExecutor(1)


def _in_one_thread(function: Callable[..., Any], *task: Any) -> Any:
    return _one_thread.submit(function, *task).result()


_built: dict[Hashable, Any] = {}


def built_once(key: Hashable, build: Callable[[], T], most: int = 1) -> T:
    """What this worker keeps from task to task: what was built under this key, or is built now, on one CPU
    thread of Taichi.

    Taichi starts anew for it, and all else is lost, where already ``most`` are kept.
    """
    if key not in _built:
        if not _built or len(_built) >= most:
            _built.clear()
            sim.device.start("cpu", cpu_max_num_threads=1)
        _built[key] = build()
    return _built[key]


def error_of(future: Future) -> BaseException | None:
    """The error of a future that has ended; also that it was cancelled."""
    try:
        return future.exception()
    except CancelledError as error:
        return error


def has_ended(error: BaseException | None) -> bool:
    """Whether an error means that a worker has ended, and not that its task has failed."""
    # Dask's error, without importing Dask.
    return isinstance(error, ENDED) or type(error).__name__ == "KilledWorker"


def _begin(parent: int) -> None:
    # A worker keeps what it has built. loky would take that for a leak of memory, and replace the worker.
    process_executor._MAX_MEMORY_LEAK_SIZE = 1 << 60
    end_with_parent(parent)


def end_with_parent(parent: int) -> None:
    """Initialise a worker: it ends itself soon after its parent, a process id, has ended.

    Workers of a pool whose process was killed would otherwise finish their tasks and wait for more.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    # An orphan has another parent, or none. The id of a killed parent may still exist, until somebody waits
    # for it.
    while (process := psutil.Process().parent()) is not None and process.pid == parent:
        time.sleep(WATCH_S)
    os._exit(1)
