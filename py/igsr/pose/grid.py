"""How a network's pixels lie in a photo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """How the grid of a photo's predictions lies in the photo.

    photo coordinates = grid coordinates * scale + offset, both with pixel centres at +0.5.

    Attributes:
        height: rows of the grid.
        width: columns of the grid.
        scale_x: photo pixels per column.
        scale_y: photo pixels per row.
        offset_x: photo pixels left of the grid.
        offset_y: photo pixels above the grid.

    Raises:
        IgsrError: a field is not a positive whole number (height, width), not positive and finite
            (scales) or not finite (offsets).
    """

    height: int
    width: int
    scale_x: float
    scale_y: float
    offset_x: float
    offset_y: float

    def __post_init__(self) -> None:
        """Check the fields."""
        for name in ("height", "width"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise IgsrError(f"a grid's {name} is {value!r}; give a whole number of at least 1")
        for name in ("scale_x", "scale_y"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise IgsrError(f"a grid's {name} is {getattr(self, name)!r}; give a positive one")
        for name in ("offset_x", "offset_y"):
            if not np.isfinite(getattr(self, name)):
                raise IgsrError(f"a grid's {name} is {getattr(self, name)!r}; give a finite one")

    def over_photo(self, plane: np.ndarray, width: int, height: int) -> np.ndarray:
        """One number per pixel of the grid [h, w] as such numbers of the whole photo [H, W].

        Args:
            plane: of the grid's size.
            width, height: of the photo, pixels.

        Returns:
            At about the grid's resolution, each number that of the pixel which its middle lies in,
            and 0 where the grid does not reach.
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
        found = plane[np.ix_(rows.clip(0, self.height - 1), columns.clip(0, self.width - 1))]
        return np.where(inside, found, np.zeros_like(found))

    def photo_pixels(self, stride: int = 1) -> Float64:
        """Photo coordinates [P, 2] (x, y) of the pixels that ``kept`` keeps, row by row."""
        rows, columns = (
            np.arange(size)[kept(size, stride)] + 0.5 for size in (self.height, self.width)
        )
        x, y = np.meshgrid(
            columns * self.scale_x + self.offset_x, rows * self.scale_y + self.offset_y
        )
        return np.stack([x.ravel(), y.ravel()], axis=1)


def kept(size: int, stride: int) -> slice:
    """Every ``stride``-th of ``size`` rows or columns, evenly about the middle; at least one."""
    stride = min(stride, size)
    return slice((size - 1) % stride // 2, None, stride)
