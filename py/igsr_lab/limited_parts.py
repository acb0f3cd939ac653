"""Parts of a long measurement, each in its own process and under a time limit."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from igsr.errors import IgsrError

#: Time limit for a killed part to end: a driver may hold it.
END_TIMEOUT_SECONDS = 5.0

#: Entries of a report, for JSON.
Entries = dict[str, Any]


@dataclass(frozen=True)
class Part:
    """One part."""

    name: str
    limit_s: float
    #: A module's function, also by ``partial``. It yields entries; those before an error are kept.
    work: Callable[[], Iterable[Entries]]
    variables: Mapping[str, str] = field(default_factory=dict)  # of its environment


def run_part(part: Part) -> tuple[list[Entries], str | None]:
    """Run a part to its end or time limit; return its entries, and the error if there is one."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "entries.jsonl"
        arguments = (part.work, dict(part.variables), file)
        running = multiprocessing.get_context("spawn").Process(target=_work, args=arguments)
        running.start()
        try:
            running.join(part.limit_s)
            late = running.is_alive()
        finally:
            if running.is_alive():
                _kill(running)
        lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    entries = []
    for line in lines:
        with contextlib.suppress(json.JSONDecodeError):  # the last line of a killed process
            entries.append(json.loads(line))
    if entries and "error" in entries[-1]:
        return entries[:-1], entries[-1]["error"]
    if late:
        return entries, f"It did not end within {part.limit_s:g} s."
    if running.exitcode != 0:
        return entries, f"Its process ended with status {running.exitcode}."
    return entries, None


def _kill(running: BaseProcess) -> None:
    """Kill a part and its children."""
    assert running.pid is not None
    if hasattr(os, "killpg"):
        with contextlib.suppress(OSError):  # it has no group yet, or has just ended
            os.killpg(running.pid, signal.SIGKILL)
    running.kill()
    running.join(END_TIMEOUT_SECONDS)


def _work(work: Callable[[], Iterable[Entries]], variables: dict[str, str], file: Path) -> None:
    if hasattr(os, "setsid"):
        os.setsid()
    os.environ.update(variables)
    with file.open("w", encoding="utf-8") as lines:
        try:
            for entries in work():
                print(json.dumps(entries, allow_nan=False), file=lines, flush=True)
        except Exception as error:  # of any kind; the next part runs
            is_sentence = isinstance(error, IgsrError | RuntimeError)
            text = str(error) if is_sentence else f"{type(error).__name__}: {error}"
            print(json.dumps({"error": text}), file=lines)
