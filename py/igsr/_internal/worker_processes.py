"""Processes that do independent work side by side and end with the one that started them."""

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

#: Environment variables that say how many threads to start.
THREADS = ("RAYON_NUM_THREADS", "OMP_NUM_THREADS")


class WorkerLostError(IgsrError):
    """A process that did work ended without a result, for example because memory ran out."""


def worker_processes(count: int, threads: int | None = None) -> ProcessPoolExecutor:
    """A pool of ``count`` processes, each with ``threads`` threads (None: as they like).

    They are started anew and not forked, since threads do not survive that. A pool's processes
    would work on by themselves if the one that started them was killed.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, context, _begin, (threads,))


def _begin(threads: int | None) -> None:
    """In a worker, before anything starts threads."""
    # Ctrl-C goes to all processes of a terminal. The one that started them says what it means.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if threads is not None:
        os.environ.update(dict.fromkeys(THREADS, str(threads)))
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def in_a_process(work: Callable[..., T], *arguments: Any) -> T:
    """Call a function of a module in a process of its own, which ends with the call.

    Raises:
        WorkerLostError: the process was ended from outside, for example because memory ran out.
        Exception: what the function raises.
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
