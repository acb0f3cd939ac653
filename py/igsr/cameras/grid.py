"""Pixel grids of networks: how they lie in a photo, and which of their pixels may be used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture.photo_folder import Photo

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Grid:
    """Position of a network's pixel grid in a photo.

    photo coordinates = grid coordinates * scale + offset, both with pixel centers at +0.5.
    """

    height: int
    width: int
    scale_x: float  # photo pixels per column
    scale_y: float  # photo pixels per row
    offset_x: float  # photo pixels left of the grid
    offset_y: float  # photo pixels above the grid

    def over_photo(self, plane: np.ndarray, width: int, height: int) -> np.ndarray:
        """Resample a plane of the grid to the whole photo, at about the grid's resolution.

        Args:
            plane: [h, w], of the grid's size.
            width, height: of the photo, pixels.

        Returns:
            [H, W]: the values of the nearest pixels of the grid, 0 outside the grid.
        """
        rows, columns = (
            np.floor((((np.arange(count) + 0.5) * size / count) - offset) / scale).astype(np.int64)
            for count, size, offset, scale in (
                (max(1, round(height / self.scale_y)), height, self.offset_y, self.scale_y),
                (max(1, round(width / self.scale_x)), width, self.offset_x, self.scale_x),
            )
        )
        inside = np.outer(
            (rows >= 0) & (rows < self.height), (columns >= 0) & (columns < self.width)
        )
        values = plane[np.ix_(rows.clip(0, self.height - 1), columns.clip(0, self.width - 1))]
        return np.where(inside, values, np.zeros_like(values))

    def photo_pixels(self, stride: int = 1) -> Float64:
        """Photo coordinates [P, 2] (x, y) of the grid's pixels, row by row, thinned by a stride."""
        rows, columns = (
            np.arange(size)[thinned(size, stride)] + 0.5 for size in (self.height, self.width)
        )
        x, y = np.meshgrid(
            columns * self.scale_x + self.offset_x, rows * self.scale_y + self.offset_y
        )
        return np.stack([x.ravel(), y.ravel()], axis=1)

    def cells(self, pixels: Float64) -> tuple[Int64, Int64, Bool]:
        """Rows and columns of the grid at photo pixels [M, 2], and which pixels are in the grid.

        Rows and columns of pixels outside the grid are 0.
        """
        cells = (pixels - [self.offset_x, self.offset_y]) / [self.scale_x, self.scale_y]
        inside: Bool = np.all((cells >= 0.0) & (cells < [self.width, self.height]), axis=1)
        column, row = np.where(inside[:, None], cells, 0.0).astype(np.int64).T
        return row, column, inside

    def usable(self, photo: Photo) -> Bool:
        """Pixels [h, w] of the grid that are neither masked nor transparent in the photo."""
        height, width = photo.image.shape[:2]
        column = (np.arange(self.width) + 0.5) * self.scale_x + self.offset_x
        row = (np.arange(self.height) + 0.5) * self.scale_y + self.offset_y
        at = np.ix_(
            np.clip(np.floor(row).astype(np.int64), 0, height - 1),
            np.clip(np.floor(column).astype(np.int64), 0, width - 1),
        )
        usable = np.ones((self.height, self.width), dtype=bool)
        if photo.mask is not None:
            usable &= photo.mask[at]
        if photo.image.shape[2] == 4:
            usable &= photo.image[..., 3][at] > 0
        return usable


def ray_slopes(pixels: np.ndarray, K: Float64) -> Float64:
    """(x, y) [P, 2] of the rays (x, y, 1) through pixels [P, 2] of a camera."""
    slopes: Float64 = (pixels - K[[0, 1], 2]) / K[[0, 1], [0, 1]]
    return slopes


def thinned(size: int, stride: int) -> slice:
    """Every ``stride``-th of ``size`` rows or columns, centered; at least one."""
    stride = min(stride, size)
    return slice((size - 1) % stride // 2, None, stride)


def on_white(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Composite a photo [H, W, 3 or 4] on white; uint8 [H, W, 3]."""
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:].astype(np.uint16)
    blended = image[..., :3] * alpha + 255 * (255 - alpha)
    return ((blended + 127) // 255).astype(np.uint8)
