"""Options and the time estimate that several lab commands share."""

from __future__ import annotations

import time
from typing import Annotated

import typer

JobsOption = Annotated[
    int, typer.Option("--jobs", help="How many fits run at the same time; they share the cores.")
]
RayOption = Annotated[
    bool, typer.Option("--ray", help="Work on a Ray cluster (pip install 'igsr\\[ray]').")
]


class TimeLeft:
    """An estimate of the time left, from the runs done by this process.

    Runs that were finished before it started do not count.
    """

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._before: int | None = None

    def __call__(self, done: int, total: int) -> str:
        """The time left in words, once ``done`` of ``total`` runs are finished."""
        if self._before is None:
            self._before = done - 1
        each = (time.monotonic() - self._started) / (done - self._before)
        return f"about {each * (total - done) / 60.0:.0f} min left"
