"""Sums and extremes in windows of pixels, and connected regions."""

from __future__ import annotations

import functools
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]
Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


def window_min(values: Array, radius: int) -> Array:
    """Minimum of values [H, W, ...] within ``radius`` rows and columns of each pixel."""
    return _window_extreme(np.minimum, values, radius)


def window_max(values: Array, radius: int) -> Array:
    """Maximum of values [H, W, ...] within ``radius`` rows and columns of each pixel."""
    return _window_extreme(np.maximum, values, radius)


def _window_extreme(extreme: np.ufunc, values: Array, radius: int) -> Array:
    for _ in range(2):
        padded = np.pad(values, [(radius, radius)] + [(0, 0)] * (values.ndim - 1), mode="edge")
        shifted = (padded[shift : shift + len(values)] for shift in range(2 * radius + 1))
        values = functools.reduce(extreme, shifted).swapaxes(0, 1)
    return values


def box_sums(values: Array, radius: int) -> Float64:
    """Sums of values [H, W, ...] within ``radius`` rows and columns of each pixel; same shape."""
    side, rest = 2 * radius + 1, [(0, 0)] * (values.ndim - 2)
    sums = np.pad(values.astype(np.float64), [(radius + 1, radius)] * 2 + rest)
    sums = sums.cumsum(axis=0).cumsum(axis=1)
    return np.asarray(
        sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    )


def labels(mask: Bool) -> Int64:
    """Number the connected regions (eight neighbors) of a mask [H, W] from 1; 0 elsewhere."""
    # Each pixel ends with the largest index in its region, plus 1.
    number = np.where(mask, np.arange(1, mask.size + 1).reshape(mask.shape), 0)
    while True:
        largest = np.where(mask, window_max(number, 1), 0)
        # Jump to the number of the pixel with that index, which takes few iterations.
        largest = np.where(mask, largest.reshape(-1)[np.maximum(largest, 1) - 1], 0)
        if np.array_equal(largest, number):
            break
        number = largest
    _, compact = np.unique(np.append(0, number), return_inverse=True)
    return np.asarray(compact[1:].reshape(mask.shape), np.int64)
