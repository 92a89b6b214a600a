"""Worker processes that end when the process that started them was killed."""

import os
import threading
import time

import psutil
from joblib import cpu_count, parallel_config

WATCH_S = 0.5


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
