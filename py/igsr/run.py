"""One run: a call of ``igsr.fit``, ``igsr.refine``, ``igsr.find_cameras`` or ``igsr.compact``.

A run reports events, measures its stages and names the files in its folder. A listener that raises
an exception, such as KeyboardInterrupt, ends the run; fits save their checkpoint first.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from igsr._internal.event import CAMERAS_FOUND, NOTE, SCENE_WRITTEN, Event, Listener
from igsr._internal.folder_lock import folder_lock
from igsr._internal.part_usage import Parts
from igsr._internal.progress_bar import is_interactive, nested, progress_bar
from igsr.errors import IgsrError

__all__ = ["CAMERAS_FOUND", "NOTE", "SCENE_WRITTEN", "Event", "Listener", "Run", "open_run"]


class Run:
    """Events, files and usage of one run.

    Attributes:
        out: folder of the run; None if nothing is written.
        resume: whether the run continues from the checkpoints in ``out``.
        parts: seconds and memory of each stage.
    """

    def __init__(
        self,
        out: str | os.PathLike[str] | None = None,
        listeners: tuple[Listener, ...] = (),
        *,
        resume: bool = False,
    ) -> None:
        """Touch no file yet.

        Raises:
            IgsrError: ``out`` is a file, or ``resume`` is given without ``out``.
        """
        if resume and out is None:
            raise IgsrError("resume needs out, the folder of the run to continue.")
        if out == "":
            raise IgsrError("out is empty; name a folder.")
        self.out = None if out is None else Path(out)
        if self.out is not None:
            existing = next((p for p in (self.out, *self.out.parents) if p.exists()), None)
            if existing is not None and not existing.is_dir():
                raise IgsrError(f"out is {self.out}, and {existing} is a file; name a folder.")
        self.resume = resume
        self.parts = Parts()
        #: Whether a person or a program follows the events.
        self.is_followed = bool(listeners)
        self._listeners = list(listeners)

    def add_listener(self, listener: Listener) -> None:
        """Send all further events to ``listener``, too."""
        self._listeners.append(listener)

    def report(self, event: Event) -> None:
        """Send an event to the listeners."""
        for listener in self._listeners:
            listener(event)

    def note(self, message: str) -> None:
        """Send a message for people."""
        self.report(Event(NOTE, message=message))

    def wrote(self, stage: str, path: Path) -> None:
        """Report a file that now exists."""
        self.report(Event(stage, 1.0, path=path))


@contextlib.contextmanager
def open_run(
    out: str | os.PathLike[str] | None, progress: Listener | None, *, resume: bool = False
) -> Iterator[Run]:
    """A run that shows a progress bar in interactive sessions where ``progress`` is None.

    Runs within a run show no bars of their own, and write into its folder.

    Raises:
        IgsrError: as ``Run``, or another run writes into the folder.
    """
    with nested() as is_outermost, contextlib.ExitStack() as closing:
        if progress is None and is_outermost and is_interactive():
            progress = closing.enter_context(progress_bar())
        run = Run(out, () if progress is None else (progress,), resume=resume)
        if run.out is not None and is_outermost:
            closing.enter_context(folder_lock(run.out))
        yield run
