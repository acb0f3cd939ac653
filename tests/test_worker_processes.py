"""Worker processes: their threads, and that none is left over."""

import os
import signal
import subprocess
import sys
import time

import pytest

from igsr._internal.worker_processes import WorkerLostError, in_a_process, worker_processes

#: Starts a worker, says its number, and waits for it.
PARENT = """
import os, time
from igsr._internal.worker_processes import worker_processes

if __name__ == "__main__":
    with worker_processes(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 600).result()
"""


def test_each_has_its_share_of_threads():
    with worker_processes(2, threads=3) as pool:
        assert pool.submit(os.getenv, "OMP_NUM_THREADS").result() == "3"
        assert pool.submit(os.getenv, "RAYON_NUM_THREADS").result() == "3"


def test_a_process_that_ends_without_a_result_is_lost():
    with pytest.raises(WorkerLostError, match="may have run out of memory"):
        in_a_process(os._exit, 9)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
def test_none_works_on_when_the_one_that_started_it_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
        os.kill(worker, 0)
        parent.send_signal(signal.SIGKILL)
    for _ in range(100):
        if not _runs(worker):
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    pytest.fail("the worker works on")


def _runs(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    stat = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True)
    return not stat.stdout.startswith("Z")  # it has ended
