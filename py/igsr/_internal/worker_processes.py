"""Processes that do independent work side by side and end with the one that started them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor

#: Environment variables that say how many threads to start.
THREADS = ("RAYON_NUM_THREADS", "OMP_NUM_THREADS")


def worker_processes(count: int, threads: int | None = None) -> ProcessPoolExecutor:
    """A pool of ``count`` processes, each with ``threads`` threads (None: as they like).

    They are started anew and not forked, since threads do not survive that. A pool's processes
    would work on by themselves if the one that started them was killed.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(count, context, _begin, (threads,))


def _begin(threads: int | None) -> None:
    """In a worker, before anything starts threads."""
    if threads is not None:
        os.environ.update(dict.fromkeys(THREADS, str(threads)))
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
