"""Options and the time estimate that several lab commands share."""

from __future__ import annotations

import time
from typing import Annotated

from igsr.cli.options import option

JobsOption = Annotated[int, option("--jobs", help="Parallel runs, which share the cores.")]
RayOption = Annotated[bool, option("--ray", help="Use a Ray cluster (pip install 'igsr\\[ray]').")]


class TimeLeft:
    """An estimate of the time left, from the runs of this process."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._before: int | None = None

    def __call__(self, done: int, total: int) -> str:
        """The time left in words, after ``done`` of ``total`` runs."""
        if self._before is None:
            self._before = done - 1
        each = (time.monotonic() - self._started) / (done - self._before)
        return f"about {each * (total - done) / 60.0:.0f} min left"
