"""Workers on this machine, some of them killed, and on a Dask cluster."""

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from types import SimpleNamespace

import psutil
import pytest
from conftest import ROOT

from app import main
from errors import UserError
from rehearsal import worker_processes
from rehearsal.worker_processes import WATCH_S, WorkerError, Workers, built_once, error_of, has_ended

# A pool of two, one of them busy for longer than the test and one idle, which says who they are and waits.
PARENT = """
import os, time
from rehearsal.worker_processes import Workers
if __name__ == "__main__":
    workers = Workers(2)
    pool = workers._executor
    busy = pool.submit(time.sleep, 60)
    pool.submit(os.getpid).result()
    print(*pool._processes, flush=True)
    time.sleep(60)
"""


def test_workers_end_when_their_process_is_killed_and_not_before(tmp_path):
    (tmp_path / "parent.py").write_text(PARENT)
    line = [
        sys.executable,
        "-c",
        f"import runpy; runpy.run_path({str(tmp_path / 'parent.py')!r}, run_name='__main__')",
    ]
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE, text=True) as parent:
        workers = [psutil.Process(int(pid)) for pid in parent.stdout.readline().split()]
        assert len(workers) == 2
        gone, _ = psutil.wait_procs(workers, 1.5 * WATCH_S)
        assert not gone
        # Killed, and not yet waited for: until then the system still knows it.
        parent.kill()
        _, alive = psutil.wait_procs(workers, WATCH_S + 5.0)
        for each in alive:
            each.kill()
        assert not alive


def late(number: int, seconds: float) -> tuple[int, int]:
    time.sleep(seconds)
    return number, os.getpid()


def failing(number: int) -> int:
    if number == 2:
        raise UserError("two")
    return number


def ending(number: int) -> None:
    os._exit(1)


# A late first task, and more tasks than are queued at once.
LATE = [(number, 0.4 if number == 0 else 0.0) for number in range(9)]


@pytest.mark.parametrize("where", ["here", "there"])
def test_results_come_in_order_whatever_ends_first_and_errors_are_the_tasks_own(where, request):
    dask = request.getfixturevalue("cluster") if where == "there" else None
    with Workers(2, dask) as workers:
        found = list(workers.map(late, LATE))
        assert [number for number, _ in found] == list(range(9))
        # Even one process here is another one; the cluster's worker is this one.
        assert {process == os.getpid() for _, process in found} == {where == "there"}
        order = [number for number, _ in workers.completed(late, LATE)]
        assert sorted(order) == list(range(9)) and (order[0] == 0) == (where == "there")
        results = workers.map(failing, [(number,) for number in range(5)])
        assert [next(results), next(results)] == [0, 1]
        with pytest.raises(UserError, match="two"):
            next(results)
        assert list(workers.map(late, [])) == []
        shared = workers.share((3, 0.0))
        assert list(workers.map(max, [(shared, (2, 9.0))])) == [(3, 0.0)]


def test_tasks_are_taken_as_there_is_a_worker_for_them_soon():
    taken = []

    def tasks():
        for number in range(20):
            taken.append(number)
            yield number, 0.0

    with Workers(1) as workers:
        next(workers.map(late, tasks()))
        assert len(taken) <= 3


def test_what_has_ended_comes_before_the_next_task_is_made():
    """Which may take long."""
    made = []

    def tasks():
        for number in range(4):
            made.append(number)
            yield number, 0.0
            time.sleep(1.0)

    with Workers(2) as workers:
        list(workers.map(late, LATE))
        _, future = next(workers.completed(late, tasks()))
        assert future.result()[0] == 0 and len(made) <= 3


class KilledWorker(Exception):
    """As Dask's."""


def test_cancelled_futures_and_killed_workers_are_no_errors_of_a_task():
    cancelled: Future = Future()
    cancelled.cancel()
    assert has_ended(error_of(cancelled)) and has_ended(KilledWorker())
    assert not has_ended(None) and not has_ended(UserError("two"))


def test_a_stop_is_an_error_for_a_waiting_thread():
    with Workers(1) as workers:
        waiting = workers.map(time.sleep, [(60,)] * 9)
        threading.Timer(0.5, workers.stop).start()
        with pytest.raises(WorkerError, match="was ended"):
            list(waiting)
        with pytest.raises(WorkerError, match="was ended"):
            list(workers.map(time.sleep, [(60,)]))


def test_a_process_that_ended_is_an_error_in_one_line():
    with Workers(2) as workers, pytest.raises(WorkerError) as error:
        list(workers.map(ending, [(1,)]))
    assert "a worker process was ended" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.usefixtures("nothing_built")
def test_a_worker_keeps_what_it_built_up_to_the_limit_of_taichi(monkeypatch):
    started, built = [], []
    monkeypatch.setattr(
        worker_processes.sim,
        "device",
        SimpleNamespace(start=lambda *given, **options: started.append((given, options))),
    )

    def build() -> int:
        built.append(len(built))
        return built[-1]

    found = []
    for key in (*"abab", "c", *"ca"):
        found.append(built_once(key, build, 2))
    assert found == [0, 1, 0, 1, 2, 2, 3] and len(started) == 2
    assert started[0] == (("cpu",), dict(cpu_max_num_threads=1))


def thread(number: int) -> tuple[int, str]:
    time.sleep(0.05)
    return threading.get_ident(), threading.current_thread().name


def test_a_dask_worker_of_several_threads_computes_in_one(cluster):
    """Taichi fails in another one than has started it."""
    with Workers(dask=cluster) as workers:
        assert workers.count == 1
        assert len(set(workers.map(thread, [(number,) for number in range(6)]))) == 1


def test_a_cluster_without_workers_or_with_some_that_lack_modules_is_refused(monkeypatch):
    import distributed

    def broken(client, work):
        raise Exception("ModuleNotFoundError(\"No module named 'studies'\")")

    with distributed.LocalCluster(n_workers=0, dashboard_address=None) as cluster:
        for words in ("has no workers", "No module named 'studies'.*its folder in PYTHONPATH"):
            with pytest.raises(WorkerError, match=words), Workers(dask=cluster.scheduler_address):
                pytest.fail("it went on without workers")
            monkeypatch.setattr(distributed.Client, "run", broken)


def test_a_wrong_address_is_refused_in_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(worker_processes, "CONNECT_S", 0.3)
    line = ["study", "stability", "--quick", "--out", str(tmp_path / "out"), "--dask", "tcp://127.0.0.1:9"]
    for words in ("no scheduler answers there", "pip install dask distributed"):
        assert main(line) == 2
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert said.startswith("nephron: ") and words in said
        monkeypatch.setitem(sys.modules, "distributed", None)
