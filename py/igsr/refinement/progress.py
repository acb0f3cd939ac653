"""The progress of a refinement: events by stage, and the time that each stage takes."""

from __future__ import annotations

from igsr._internal.event import Event
from igsr._internal.part_usage import Meter
from igsr.refinement.results import Stage
from igsr.run import Run

#: Stages as events name them.
STAGE_NAMES: dict[str, str] = {
    "fit": "fit photos",
    "novel_views": "denoise novel views",
    "refit": "refit with novel views",
    "test": "score test views",
}


class RefineProgress:
    """Counts work in units of a fit to all photos.

    Attributes:
        round: number of the current round; 0 is the fit to the photos alone.
        has_news: whether anything was done since the run began or was resumed.
    """

    def __init__(self, run: Run, work: float) -> None:
        """Start the clock; ``work`` is the maximum work of the refinement."""
        self.round = 0
        self.has_news = not run.resume
        self._run, self._work, self._done = run, work, 0.0
        self._meter = Meter()

    def report(self, stage: Stage, work: float = 0.0, message: str = "") -> None:
        """Report progress, and add the time since the last call to a stage.

        Args:
            stage: the current stage.
            work: work of the current fit that is done.
            message: details.
        """
        if work > 0.0:
            self.has_news = True
        self._run.parts.add(stage, self._meter.lap())
        part = min(1.0, (self._done + work) / self._work)
        text = f"round {self.round}" + (f": {message}" if message else "")
        values = {"round": float(self.round)}
        self._run.report(Event(STAGE_NAMES[stage], message=text, part=part, values=values))

    def add_work(self, work: float) -> None:
        """Count finished work."""
        self._done += work
