"""What networks are shown of photos, and which of their predictions are of use."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture.photo_folder import Photo
from igsr.pose.grid import Grid


def usable(photo: Photo, grid: Grid) -> npt.NDArray[np.bool_]:
    """Which samples [h, w] of a grid fall on pixels that are neither masked nor transparent."""
    column = _sampled(grid.width, grid.scale_x, grid.offset_x, photo.image.shape[1])
    row = _sampled(grid.height, grid.scale_y, grid.offset_y, photo.image.shape[0])
    at = np.ix_(row, column)
    shown = np.ones((grid.height, grid.width), dtype=bool)
    if photo.mask is not None:
        shown &= photo.mask[at]
    if photo.image.shape[2] == 4:
        shown &= photo.image[..., 3][at] > 0
    return shown


def _sampled(count: int, scale: float, offset: float, size: int) -> npt.NDArray[np.int64]:
    at = (np.arange(count) + 0.5) * scale + offset
    return np.clip(np.floor(at).astype(np.int64), 0, size - 1)


def over_white(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The photo uint8 [H, W, 3] with what is transparent in white; [H, W, 4] may have alpha."""
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:].astype(np.uint16)
    over_white = image[..., :3] * alpha + 255 * (255 - alpha)
    return ((over_white + 127) // 255).astype(np.uint8)
