"""Workers whose process is killed, as real processes."""

import subprocess
import sys

import psutil
from conftest import ROOT

from rehearsal.worker_processes import WATCH_S

# A pool of two, one of them busy for longer than the test and one idle, which says who they are and waits.
PARENT = """
import os, time
from joblib.externals.loky import ProcessPoolExecutor
from rehearsal.worker_processes import end_with_parent
if __name__ == "__main__":
    pool = ProcessPoolExecutor(2, initializer=end_with_parent, initargs=(os.getpid(),))
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
