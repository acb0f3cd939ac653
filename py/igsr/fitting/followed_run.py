"""Files in the folder of a run that ``igsr view --web`` follows.

``view/`` holds ``run.json`` (the background), ``progress.json`` while the run goes on, and some
photos with ``cameras.json``: held-out photos in ``held-out/``, else fitted ones in ``fitted/``.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np
from PIL import Image

from igsr._internal.atomic_write import atomic_write
from igsr._internal.event import NOTE, Event
from igsr._internal.json_file import write_json
from igsr.capture import Capture, View
from igsr.capture.write_cameras import write_cameras
from igsr.capture.write_files import png_names
from igsr.errors import IgsrError
from igsr.evaluation.scores import over_background
from igsr.rendering.run_folder import CAMERAS, PROGRESS, RUN, VIEW

#: Folders of photos, by their split.
PHOTOS = {"test": "held-out", "train": "fitted"}
#: Maximum number of photos, evenly spaced, and the longest side of each, pixels.
MAX_PHOTOS = 12
MAX_SIDE_PX = 1000
#: Seconds between two writes of the progress.
WRITE_EVERY_S = 2.0


class FollowedRun:
    """A listener that publishes a run's progress; errors while writing are ignored."""

    def __init__(self, out: Path) -> None:
        """Write nothing before the first event."""
        self._folder = out / VIEW
        self._photos: tuple[Capture, list[float]] | None = None
        self._written_at: float | None = None

    def __call__(self, event: Event) -> None:
        """Write the progress, at most every ``WRITE_EVERY_S`` seconds."""
        now = time.monotonic()
        is_due = self._written_at is None or now - self._written_at >= WRITE_EVERY_S
        if not is_due or event.path is not None or event.stage == NOTE:
            return
        counts = f" {event.done:.0f} of {event.total:.0f}" if event.total > 1 else ""
        text = f"{event.stage}{counts}{', ' if event.message else ''}{event.message}"
        with contextlib.suppress(OSError, IgsrError):
            if self._photos is not None:
                photos, self._photos = self._photos, None
                self._write_photos(*photos)
            done = min(1.0, max(0.0, event.part or 0.0))
            write_json(self._folder / PROGRESS, {"text": text, "done": done})
        self._written_at = now

    def show(self, capture: Capture, background: Sequence[float]) -> None:
        """Publish some photos with the next event.

        Args:
            capture: photos and cameras.
            background: RGB in [0, 1] behind the splats and behind photos with alpha.
        """
        self._photos = (capture, [float(channel) for channel in background])
        self._written_at = None

    def __enter__(self) -> FollowedRun:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Remove the progress: the run has ended."""
        with contextlib.suppress(OSError):
            (self._folder / PROGRESS).unlink()
            self._folder.rmdir()  # only if it is empty, because no fit began

    def _write_photos(self, capture: Capture, background: list[float]) -> None:
        views = capture.test_views or capture.train_views
        chosen = np.unique(np.linspace(0, len(views) - 1, MAX_PHOTOS).round().astype(int))
        for name in PHOTOS.values():
            for path in (self._folder / name).glob("**/*.jpg"):
                path.unlink()
        _write_jpegs(self._folder, [views[k] for k in chosen], background)
        write_json(self._folder / RUN, {"background": background})


def _write_jpegs(folder: Path, views: list[View], background: Sequence[float]) -> None:
    renamed = []
    for view, name in zip(views, png_names(views), strict=True):
        photo = Image.fromarray(over_background(view.image, background))
        photo.thumbnail((MAX_SIDE_PX, MAX_SIDE_PX))
        path = (Path(PHOTOS[view.split]) / name).with_suffix(".jpg")
        with atomic_write(folder / path) as temporary:
            photo.save(temporary, format="JPEG", quality=90)
        renamed.append(replace(view, name=path.as_posix()))
    write_cameras(folder / CAMERAS, renamed)
