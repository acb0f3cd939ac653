"""Progress bars on stderr for the events of a run (``igsr.run.Event``)."""

from __future__ import annotations

import contextlib
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

from igsr._internal.event import NOTE, Event
from igsr.errors import printable

#: Set within a run: the runs that it starts show no bars of their own.
_in_run: ContextVar[bool] = ContextVar("igsr_in_run", default=False)


@contextlib.contextmanager
def progress_bar(*, shown: bool = True) -> Iterator[Callable[[Event], None]]:
    """A bar on stderr, if that is a terminal; yields the function that shows an event.

    The bar appears with the first event, so an earlier error is a single line. Events with a
    fraction of the whole run move one bar; other stages have a bar of their own.
    """
    # The import takes half of a short command's time.
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from igsr._internal.plain_console import PlainConsole

    console = PlainConsole(sys.stderr)
    bar = Progress(
        TextColumn("{task.description} {task.fields[counts]}", markup=False),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[message]}", markup=False),
        TimeRemainingColumn(compact=True),
        console=console,
        # Elsewhere, rich would print an empty line in place of the bar.
        disable=not (shown and (console.is_interactive or console.is_jupyter)),
        transient=True,
    )
    tasks: dict[str, Any] = {}

    def show(event: Event) -> None:
        if event.path is not None:
            return
        if event.stage == NOTE:
            if shown:
                console.print(event.message, soft_wrap=True)
            return
        bar.start()
        key = "whole run" if event.part is not None else event.stage
        if key not in tasks:
            for task in tasks.values():
                bar.update(task, visible=False)
            tasks[key] = bar.add_task(event.stage, total=None, counts="", message="")
        counts = f"{int(event.done)}/{event.total:.0f}" if event.total > 1 else ""
        done, total = (event.done, event.total) if event.part is None else (event.part, 1.0)
        bar.update(
            tasks[key],
            description=event.stage,
            completed=done,
            total=total,
            counts=counts,
            message=printable(event.message),
            visible=True,
        )

    try:
        yield show
    finally:
        if bar.live.is_started:
            bar.stop()


@contextlib.contextmanager
def nested() -> Iterator[bool]:
    """Mark what runs inside as part of a run; yields whether it is the outermost one."""
    is_outermost = not _in_run.get()
    token = _in_run.set(True)
    try:
        yield is_outermost
    finally:
        _in_run.reset(token)


def is_interactive() -> bool:
    """Whether Python runs in a prompt, in IPython or in a notebook."""
    if multiprocessing.parent_process() is not None:
        return False  # workers inherit what says so
    # ipykernel is also imported by programs that start a kernel; only the kernel has its app.
    return hasattr(sys, "ps1") or "ipykernel.kernelapp" in sys.modules
