"""A process under an address-space limit, and the CPU seconds and memory that it takes.

Run as a program, it watches a process. It is small: Linux counts the memory of the process that
starts another one in the peak of the new one.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass

#: Seconds after which a process is taken to wait for ever.
TIMEOUT_S = 60


@dataclass(frozen=True)
class Measured:
    """A process that has ended. ``seconds`` are of its CPU time: others may use the cores."""

    status: int
    errors: str
    seconds: float
    peak: int


def measured(words, limit):
    """Run a command with at most ``limit`` bytes of addresses."""
    watcher = [sys.executable, "-I", "-S", __file__, str(limit), *map(str, words)]
    ended = subprocess.run(watcher, capture_output=True, text=True, check=True)
    return Measured(**json.loads(ended.stdout))


def main():
    import resource
    import signal

    limit, *words = sys.argv[1:]
    limits = (int(limit), int(limit))
    process = subprocess.Popen(
        words,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, limits),
    )
    signal.signal(signal.SIGALRM, lambda *_: process.kill())
    signal.alarm(TIMEOUT_S)
    errors = process.stderr.read().decode()
    _, status, used = os.wait4(process.pid, 0)
    ended = {
        "status": os.waitstatus_to_exitcode(status),
        "errors": errors,
        "seconds": used.ru_utime + used.ru_stime,
        "peak": used.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
    }
    print(json.dumps(ended))


if __name__ == "__main__":
    main()
