"""Processes that call functions of one thread.

COLMAP's extractor holds Python's lock, and small matrix products are slower in several threads.
Processes of ``multiprocessing`` would run a user's script again. ``serve`` runs in each process.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol

from igsr.errors import IgsrError

#: Maximum number of processes; each may take 0.5 GB.
MAX_PROCESSES = 4


class Call(Protocol):
    """Calls a function of a module in a process that is free, waiting for one."""

    def __call__(self, work: Any, *arguments: Any) -> Any:
        """Return the function's result; for any thread."""


def process_count() -> int:
    """The number of processes that this machine runs at a time."""
    return min(MAX_PROCESSES, os.cpu_count() or 1)


@contextlib.contextmanager
def processes(count: int) -> Iterator[Call]:
    """Start processes.

    Args:
        count: number of processes.

    Raises:
        IgsrError: by a call whose process ended.
    """
    command = [sys.executable, "-c", f"from {__name__} import serve; serve()"]
    path = str(Path(__file__).resolve().parents[3])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    free: SimpleQueue[subprocess.Popen[bytes]] = SimpleQueue()

    def call(work: Any, *arguments: Any) -> Any:
        process = free.get()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            pickle.dump((work, arguments), process.stdin, pickle.HIGHEST_PROTOCOL)
            process.stdin.flush()
            return pickle.load(process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            raise IgsrError(
                "Finding cameras ended early; the machine may have run out of memory."
            ) from error
        finally:
            free.put(process)

    with contextlib.ExitStack() as closing:
        for _ in range(count):
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
            )
            free.put(closing.enter_context(process))
        yield call


def serve() -> None:
    """Call pickled functions from stdin until it ends; write their results to stdout."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process by its stdin
    while True:
        try:
            work, arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(work(*arguments), sys.stdout.buffer, pickle.HIGHEST_PROTOCOL)
        sys.stdout.buffer.flush()
