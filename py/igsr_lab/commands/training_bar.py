"""The progress bar of a training: steps, parts of the loss, rate and time left."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from igsr.cli.shared import error_console, stopped

if TYPE_CHECKING:
    from igsr_lab.denoiser.training_run import TrainingProgress

#: Parts of the loss that the bar has room for.
SHOWN = 3


@contextlib.contextmanager
def training_bar(steps: int) -> Iterator[Callable[[TrainingProgress], None]]:
    """A bar on stderr that appears with the first row of the log.

    Yields:
        What shows a row, for the ``progress`` of a training.
    """
    bar = ProgressBar(
        TextColumn("train {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[parts]}"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(compact=True),
        console=error_console(),
    )
    task = bar.add_task("train", total=steps, parts="", rate="")
    with stopped(bar):

        def show(now: TrainingProgress) -> None:
            bar.start()
            parts = list(now.parts.items())[:SHOWN]
            text = "  ".join(f"{name} {value:.4g}" for name, value in parts)
            rate = f"{now.step / now.seconds:.3g} steps/s" if now.step and now.seconds else ""
            bar.update(task, completed=now.step, parts=text, rate=rate)

        yield show
