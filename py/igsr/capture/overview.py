"""Look at the headers of photos: how many there are, their sizes, and whether they have cameras."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from igsr.capture.load import describe_capture, holds_cameras
from igsr.capture.memory_check import PhotoSizes
from igsr.capture.photo_folder import FRAMES, has_photos, photo_headers
from igsr.capture.photos import checked_headers, shot_sizes
from igsr.capture.types import check_holdout


@dataclass(frozen=True, kw_only=True)
class Overview(PhotoSizes):
    """Photos before they are decoded.

    Attributes:
        path: of the capture, folder or video.
        has_cameras: whether it is a capture, whose cameras are known.
        train: number of the photos that are for training; all of them without cameras.
    """

    path: Path
    has_cameras: bool
    train: int

    def train_photos(self, holdout: int | None) -> int:
        """Return the maximum number of photos to fit if every ``holdout``-th is held out."""
        if holdout is None:
            return self.train
        views = self.views or [1] * len(self.sizes)
        check_holdout(holdout, len(views), self.path)
        return sum(views) - sum(views[::holdout])


def look_at(
    path: str | os.PathLike[str], frames: int = FRAMES, max_size: int | None = None
) -> Overview:
    """Look at a capture, a folder of photos or a video.

    Args:
        path: as for ``igsr.load_capture`` and ``igsr.estimate_poses``.
        frames: maximum number of frames taken from each video.
        max_size: longest side in pixels of photos as they will be loaded, or None; a capture may
            have its photos at several sizes.

    Raises:
        IgsrError: nothing can be loaded from there.
    """
    path = Path(path)
    if holds_cameras(path) or not has_photos(path):
        shots = describe_capture(path, max_size).shots
        sizes = shot_sizes(shots, checked_headers(shots))
        train = sum(shot.split == "train" for shot in shots)
        return Overview(path=path, has_cameras=True, train=train, **vars(sizes))
    sizes = photo_headers(path, frames)
    return Overview(path=path, has_cameras=False, train=len(sizes.sizes), **vars(sizes))
