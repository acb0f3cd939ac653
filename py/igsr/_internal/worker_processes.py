"""Worker processes, which end with the process that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from igsr.errors import IgsrError

T = TypeVar("T")

#: Environment variables that set the number of threads.
THREADS = ("RAYON_NUM_THREADS", "OMP_NUM_THREADS")


class WorkerLostError(IgsrError):
    """A worker process ended without a result, for example because memory ran out."""


def worker_processes(count: int, threads: int | None = None) -> ProcessPoolExecutor:
    """Start a pool of ``count`` processes with ``threads`` threads each (None: the default).

    They are spawned, because forked processes lose the threads of the renderer.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, context, _initialize, (threads,))


def _initialize(threads: int | None) -> None:
    # Ctrl-C reaches all processes of a terminal; the parent reports it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if threads is not None:
        os.environ.update(dict.fromkeys(THREADS, str(threads)))
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """A pool's processes would otherwise continue after their parent was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def in_a_process(work: Callable[..., T], *arguments: Any) -> T:
    """Call a module-level function in a new process, which frees its memory at the end.

    Raises:
        WorkerLostError: the process was killed, for example because memory ran out.
        Exception: raised by the function.
    """
    with worker_processes(1) as pool:
        try:
            return pool.submit(work, *arguments).result()
        except BrokenProcessPool as error:
            raise WorkerLostError(
                "A process ended without a result; the machine may have run out of memory."
            ) from error
        except KeyboardInterrupt:
            for process in pool._processes.values():
                process.kill()  # leaving the pool would wait until the work is done
            raise
