"""What a fit or a refinement leaves in its folder for ``igsr view --web`` to follow.

``view/`` holds ``run.json`` (what is behind the splats), ``progress.json`` while the run goes on,
and some photos beside ``cameras.json``: held-out ones in ``held-out/``, else ``fitted/`` ones. The
models are the run's own checkpoints and scenes.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from igsr._internal.atomic_write import atomic_write
from igsr._internal.json_file import write_json
from igsr.capture import Capture, View
from igsr.capture.write_files import png_names
from igsr.capture.write_transforms import write_cameras
from igsr.errors import IgsrError
from igsr.evaluation.scores import over_background

#: The folder within that of the run, and its files.
VIEW = "view"
RUN = "run.json"
PROGRESS = "progress.json"
CAMERAS = "cameras.json"
#: Folders of photos, by their split.
PHOTOS = {"test": "held-out", "train": "fitted"}
#: Most photos, evenly spaced, and the longest side of each, pixels.
MOST_PHOTOS = 12
PHOTO_SIDE = 1000
#: Seconds between two reports of progress.
TELL_EVERY = 2.0


class FollowedRun:
    """Tells who follows a run where it stands. What cannot be written is left out: the run counts.

    Nothing is written before something is told.
    """

    def __init__(self, out: Path) -> None:
        """Name the folder of the run."""
        self._folder = out / VIEW
        self._photos: tuple[Capture, list[float]] | None = None
        self._told: float | None = None

    def show(self, capture: Capture, background: Sequence[float]) -> None:
        """Leave some photos to compare renders with, once something is told.

        Args:
            capture: photos and cameras.
            background: RGB in [0, 1] behind the splats, and behind photos with alpha.
        """
        self._photos = (capture, [float(channel) for channel in background])
        self._told = None

    def tell(self, text: str, done: float, *, at_once: bool = False) -> None:
        """Write where the run stands, unless that was written a moment ago.

        Args:
            text: what it is doing.
            done: part of the whole run, in [0, 1].
            at_once: write it in any case.
        """
        now = time.monotonic()
        is_news = self._told is None or at_once or now - self._told >= TELL_EVERY
        if not is_news:
            return
        with contextlib.suppress(OSError, IgsrError):
            if self._photos is not None:
                photos, self._photos = self._photos, None
                self._write(*photos)
            progress = {"text": text, "done": min(1.0, max(0.0, done))}
            write_json(self._folder / PROGRESS, progress)
        self._told = now

    def close(self) -> None:
        """Tell that the run has ended, done or not."""
        with contextlib.suppress(OSError):
            (self._folder / PROGRESS).unlink()
            # Empty where no fit began; else it stays.
            self._folder.rmdir()

    def _write(self, capture: Capture, background: list[float]) -> None:
        views = capture.test_views or capture.train_views
        chosen = np.unique(np.linspace(0, len(views) - 1, MOST_PHOTOS).round().astype(int))
        for name in PHOTOS.values():
            for path in (self._folder / name).glob("**/*.jpg"):
                path.unlink()
        _write_photos(self._folder, [views[k] for k in chosen], background)
        write_json(self._folder / RUN, {"background": background})


def _write_photos(folder: Path, views: list[View], background: Sequence[float]) -> None:
    named = []
    for view, name in zip(views, png_names(views), strict=True):
        photo = Image.fromarray(over_background(view.image, background))
        photo.thumbnail((PHOTO_SIDE, PHOTO_SIDE))
        path = (Path(PHOTOS[view.split]) / name).with_suffix(".jpg")
        with atomic_write(folder / path) as temporary:
            photo.save(temporary, format="JPEG", quality=90)
        named.append(replace(view, name=path.as_posix()))
    write_cameras(folder / CAMERAS, named)
