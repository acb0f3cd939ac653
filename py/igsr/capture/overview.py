"""What a path holds, from headers alone: photos, their sizes, and whether there are cameras."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from igsr.capture.load import describe_capture, holds_cameras
from igsr.capture.memory_check import check_memory
from igsr.capture.photo_folder import FRAMES, has_photos, photo_headers
from igsr.capture.photos import checked_headers, loaded_sizes, photo_of
from igsr.errors import IgsrError


@dataclass(frozen=True)
class Overview:
    """Photos before any is decoded.

    Attributes:
        path: of the capture, folder or video.
        has_cameras: whether it is a capture, whose cameras are known.
        sizes: width and height in pixels of each photo as stored. Of a video, as many as frames are
            taken at most.
        train: number of the photos that are for training; all where the cameras are not known.
        channels: of the photos: 3, or 4 if any has alpha.
        masked: whether pixels are masked, or lens distortion is to be undone.
        exact: whether there are as many photos as ``sizes`` says; videos may have fewer frames.
        views: how many of ``sizes`` each photo has, in the order of names: panoramas become several
            views. Empty where each is one view.
        decoded: width and height in pixels of the files, where these are not ``sizes``.
        depths: whether photos come with depths.
        plain: the files that are one photo each, all of whose pixels count.
    """

    path: Path
    has_cameras: bool
    sizes: list[tuple[int, int]]
    train: int
    channels: int
    masked: bool
    exact: bool
    views: list[int] = field(default_factory=list)
    decoded: list[tuple[int, int]] = field(default_factory=list)
    depths: bool = False
    plain: list[Path] = field(default_factory=list)

    def train_photos(self, holdout: int | None) -> int:
        """How many photos will be fitted, at most, if every ``holdout``-th is held out.

        Raises:
            IgsrError: these photos cannot be split so.
        """
        if holdout is None:
            return self.train
        if isinstance(holdout, bool) or not isinstance(holdout, int) or holdout < 2:
            raise IgsrError(f"holdout is {holdout!r}; give a whole number of at least 2, such as 8")
        views = self.views or [1] * len(self.sizes)
        if len(views) < 2:
            raise IgsrError(
                f"{self.path} has one photo only, so none can be held out; leave holdout out"
            )
        return sum(views) - sum(views[::holdout])

    def check_memory(self, max_size: int | None = None, splats: int | None = None) -> None:
        """Refuse photos that do not fit into memory; the message names the size that does.

        Args:
            max_size: longest side in pixels of photos as loaded, or None.
            splats: most splats of a fit to these photos, or None where they are only loaded.

        Raises:
            IgsrError: they do not fit.
        """
        check_memory(
            self.sizes,
            max_size,
            splats,
            channels=self.channels,
            masked=self.masked,
            depths=self.depths,
            decoded=self.decoded,
        )


def look_at(
    path: str | os.PathLike[str], frames: int = FRAMES, max_size: int | None = None
) -> Overview:
    """What a capture, a folder of photos or a video holds.

    Args:
        path: as ``igsr.load_capture`` and ``igsr.estimate_poses`` take it.
        frames: most frames taken from each video.
        max_size: longest side in pixels of photos as they will be loaded, or None; captures may
            have them at several sizes.

    Raises:
        IgsrError: nothing can be loaded from there.
    """
    path = Path(path)
    if holds_cameras(path) or not has_photos(path):
        described = describe_capture(path, max_size)
        headers = checked_headers(described.shots)
        shots = described.shots
        return Overview(
            path,
            True,
            loaded_sizes(shots, headers),
            sum(shot.split == "train" for shot in shots),
            max((header.channels for header in headers), default=3),
            any(shot.is_resampled or shot.mask_path is not None for shot in shots),
            True,
            [number for _, number in sorted(Counter(map(photo_of, shots)).items())],
            [header.size for header in headers],
            any(shot.depth_path is not None for shot in shots),
            [shot.path for shot in shots if shot.rig is None and shot.mask_path is None],
        )
    found = photo_headers(path, frames)
    # Whether lenses bend is not known yet: it is counted as if they did.
    return Overview(
        path,
        False,
        found.sizes,
        len(found.sizes),
        found.channels,
        True,
        found.exact,
        found.views,
        found.decoded,
        plain=found.plain,
    )
