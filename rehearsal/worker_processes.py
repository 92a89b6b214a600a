"""Worker processes that end with the process that started them, were that killed."""

import os
import threading
import time

import psutil
from joblib import cpu_count, parallel_config

WATCH_S = 0.5


def end_with(parent: int) -> None:
    """What a worker begins with: from now on it ends itself soon after its parent, a process id, is gone.

    A pool whose process is killed tells its workers nothing: they would finish what they do, and wait for more.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def processes(jobs: int | None = None) -> parallel_config:
    """While it lasts joblib works in so many processes, or as many as there are processors, that end with this one."""
    return parallel_config(
        backend="loky", n_jobs=jobs or cpu_count(), initializer=end_with, initargs=(os.getpid(),)
    )


def _watch(parent: int) -> None:
    # An orphan has another parent, or none. The process id alone would say no such thing of one that nobody has waited for.
    while (found := psutil.Process().parent()) is not None and found.pid == parent:
        time.sleep(WATCH_S)
    os._exit(1)
