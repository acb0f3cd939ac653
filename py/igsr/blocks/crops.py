"""Crops of photos: a block is fitted to the part of each photo that shows it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.capture.types import Camera, View

Float64 = npt.NDArray[np.float64]

#: Fraction of a block's visibility that may lie beyond each side of its box.
OUTSIDE_FRACTION = 0.01
#: Minimum sides of a box, as a fraction of the photo's and in pixels.
MIN_SIDE_FRACTION = 0.25
MIN_SIDE_PX = 24


@dataclass(frozen=True)
class Box:
    """A rectangle in a photo.

    Attributes:
        left, top, right, bottom: fractions of the photo's width and height, in [0, 1].
    """

    left: float = 0.0
    top: float = 0.0
    right: float = 1.0
    bottom: float = 1.0

    def pixels(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Left, top, right and bottom in a photo of this size; right and bottom are excluded."""
        left, right = _pixel_range(self.left, self.right, width)
        top, bottom = _pixel_range(self.top, self.bottom, height)
        return left, top, right, bottom

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height in pixels in a photo of this size."""
        left, top, right, bottom = self.pixels(width, height)
        return right - left, bottom - top

    @property
    def area(self) -> float:
        """Fraction of the photo's area."""
        return (self.right - self.left) * (self.bottom - self.top)


#: The box of a whole photo.
WHOLE = Box()


def _pixel_range(low: float, high: float, count: int) -> tuple[int, int]:
    first, end = int(np.floor(low * count)), int(np.ceil(high * count))
    missing = min(MIN_SIDE_PX, count) - (end - first)
    if missing > 0:
        first = max(0, min(first - missing // 2, count - MIN_SIDE_PX))
        end = min(count, first + MIN_SIDE_PX)
    return first, end


def cropped(view: View, box: Box) -> View:
    """Crop a view; the crop does not keep the whole photo in memory."""
    camera = view.camera
    left, top, right, bottom = box.pixels(camera.width, camera.height)
    if (right - left, bottom - top) == (camera.width, camera.height):
        return view

    def part(plane: np.ndarray | None) -> np.ndarray | None:
        return None if plane is None else plane[top:bottom, left:right].copy()

    K = camera.K.copy()
    K[:2, 2] -= left, top
    return replace(
        view,
        camera=Camera(camera.viewmat, K, right - left, bottom - top),
        image=view.image[top:bottom, left:right].copy(),
        mask=part(view.mask),
        depth=part(view.depth),
        depth_confidence=part(view.depth_confidence),
    )


def box_around(visibility: Float64) -> Box:
    """The box around the visible part of a block, by its fraction of each pixel [H, W]."""
    left, right = _central_range(visibility.sum(axis=0))
    top, bottom = _central_range(visibility.sum(axis=1))
    return Box(left, top, right, bottom)


def _central_range(weights: Float64) -> tuple[float, float]:
    """The range, in [0, 1], of the weights [N] without their tails, one pixel wider at each end."""
    total = np.cumsum(np.maximum(weights, 0.0))
    if total[-1] <= 0.0:
        return 0.0, 1.0
    first = int(np.searchsorted(total, OUTSIDE_FRACTION * total[-1], side="right"))
    last = int(np.searchsorted(total, (1.0 - OUTSIDE_FRACTION) * total[-1]))
    count = len(weights)
    low, high = max(0.0, (first - 1) / count), min(1.0, (last + 2) / count)
    missing = 0.5 * max(0.0, MIN_SIDE_FRACTION - (high - low))
    low, high = low - missing, high + missing
    low, high = low - max(0.0, high - 1.0), high - min(0.0, low)
    return max(0.0, low), min(1.0, high)
