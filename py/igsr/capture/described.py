"""A capture that has been read but for its photos' pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from igsr.capture.downscaling import check_max_size
from igsr.capture.memory_check import check_memory
from igsr.capture.photos import Shot, checked_headers, load_views, loaded_sizes
from igsr.capture.tracks import resized
from igsr.capture.types import Capture, Points


@dataclass(frozen=True)
class DescribedCapture:
    """What readers of captures find out before photos are decoded.

    Attributes:
        path: the folder of the capture.
        shots: its photos, in their order.
        points: reads the points, with tracks in the pixels of the shots' cameras.
    """

    path: Path
    shots: list[Shot]
    points: Callable[[], Points | None]

    def loaded(self, max_size: int | None = None) -> Capture:
        """Decode the photos.

        Args:
            max_size: longest side in pixels of photos as loaded; larger ones are reduced. None
                keeps all as they are.

        Raises:
            IgsrError: a photo or the points cannot be used, or the photos need more memory than
                there is.
        """
        check_max_size(max_size)
        headers = checked_headers(self.shots)
        check_memory(
            loaded_sizes(self.shots, headers),
            max_size,
            channels=max((header.channels for header in headers), default=3),
            masked=any(shot.is_resampled or shot.mask_path for shot in self.shots),
            depths=any(shot.depth_path for shot in self.shots),
            decoded=[header.size for header in headers],
        )
        points = self.points()
        views = load_views(self.shots, headers, max_size)
        before = {shot.name: shot.camera for shot in self.shots}
        after = {view.name: view.camera for view in views}
        return Capture(self.path, views, resized(points, before, after))
