"""Progress bars on stderr, and one for Python sessions in which nobody asked for progress.

Functions that take long have a ``progress`` argument: a function that is called now and then with
an object that says where the work stands, and may return False to end it early. Where none is
given and somebody sits before the session, a bar shows the same.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import NamedTuple, TypeVar

T = TypeVar("T")

#: Set while a function reports progress: what it calls in turn shows no bars of its own.
_reporting: ContextVar[bool] = ContextVar("igsr_reporting", default=False)


class BarState(NamedTuple):
    """What a bar shows.

    Attributes:
        done: of ``total``.
        total: of any unit.
        text: behind the bar.
        work: part of the work that is done, in [0, 1], by which the bar and the time left go; None
            where each of ``total`` takes as long.
    """

    done: float
    total: float
    text: str = ""
    work: float | None = None


@contextlib.contextmanager
def progress_bar(
    label: str, *, shown: bool = True, transient: bool = False
) -> Iterator[Callable[[BarState], None]]:
    """A bar on stderr with label, counts, text and time left; what it yields moves it.

    It appears with the first state, so that an error before that is a message alone.

    Args:
        label: before the bar.
        shown: whether there is a bar at all.
        transient: whether it goes when it is done.
    """
    # Half of a short command's time would go into this import.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.description} {task.fields[counts]}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[text]}"),
        TimeRemainingColumn(compact=True),
        console=Console(file=sys.stderr, highlight=False),
        disable=not shown,
        transient=transient,
    )
    task = bar.add_task(label, total=None, counts="", text="")

    def show(state: BarState) -> None:
        bar.start()
        # Fractions are a unit of their own, which no count explains.
        counts = f"{state.done:.0f}/{state.total:.0f}" if state.total > 1 else ""
        done = state.done if state.work is None else state.work * state.total
        bar.update(task, completed=done, total=state.total, counts=counts, text=state.text)

    try:
        yield show
    finally:
        if bar.live.is_started:
            bar.stop()


@contextlib.contextmanager
def progress_or_bar(
    progress: Callable[[T], bool | None] | None, label: str, state_of: Callable[[T], BarState]
) -> Iterator[Callable[[T], bool | None] | None]:
    """``progress`` as it was given; a bar where it is None and Python runs interactively.

    Functions that run within show no bars of their own.

    Args:
        progress: what the caller gave.
        label: of the bar.
        state_of: what the bar shows of a progress object.
    """
    outermost = not _reporting.get()
    token = _reporting.set(True)
    try:
        if progress is not None or not outermost or not is_interactive():
            yield progress
        else:
            with progress_bar(label) as show:
                yield lambda now: show(state_of(now))
    finally:
        _reporting.reset(token)


def is_interactive() -> bool:
    """Whether somebody sits before this Python: in its prompt, in IPython or in a notebook."""
    if multiprocessing.parent_process() is not None:
        return False  # a worker, which inherits what would say so
    # What starts a kernel knows ipykernel, too; only the kernel itself has its app.
    return hasattr(sys, "ps1") or "ipykernel.kernelapp" in sys.modules
