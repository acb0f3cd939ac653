"""Connected regions of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


def dilated(mask: Bool, by: int) -> Bool:
    """The mask [H, W] grown by ``by`` pixels in all eight directions."""
    out = mask.copy()
    for _ in range(by):
        rows = out.copy()
        rows[1:] |= out[:-1]
        rows[:-1] |= out[1:]
        out = rows.copy()
        out[:, 1:] |= rows[:, :-1]
        out[:, :-1] |= rows[:, 1:]
    return out


def eroded(mask: Bool, by: int) -> Bool:
    """The mask [H, W] shrunk by ``by`` pixels; what is beyond the picture counts as within."""
    return ~dilated(~mask, by)


def box_sums(values: npt.NDArray[Any], half: int) -> Float64:
    """The sum of values [H, W, ...] within ``half`` rows and columns of each pixel; same shape."""
    side, around = 2 * half + 1, [(0, 0)] * (values.ndim - 2)
    sums = np.pad(values.astype(np.float64), [(half + 1, half)] * 2 + around)
    sums = sums.cumsum(axis=0).cumsum(axis=1)
    return np.asarray(
        sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    )


def labels(mask: Bool) -> Int64:
    """A number for each connected region (eight neighbours) [H, W], from 1; 0 outside."""
    height, width = mask.shape
    # Each pixel has the largest number of its region in the end: that of its last pixel.
    number = np.where(mask, np.arange(1, mask.size + 1).reshape(height, width), 0)
    while True:
        padded = np.pad(number, 1)
        most = number
        for dy in (0, 1, 2):
            for dx in (0, 1, 2):
                most = np.maximum(most, padded[dy : dy + height, dx : dx + width])
        most = np.where(mask, most, 0)
        # Follow numbers to the numbers of their pixels: regions are done in few rounds.
        inside = most > 0
        flat = most.reshape(-1)
        most = np.where(inside, flat[np.maximum(most, 1) - 1], 0)
        if np.array_equal(most, number):
            break
        number = most
    _, compact = np.unique(number, return_inverse=True)
    out = compact.reshape(height, width).astype(np.int64)
    return out if not mask.all() else out + 1
