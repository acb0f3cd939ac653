"""More matches of two photos along their epipolar lines, by a matrix product of SIFT descriptors.

With the place of a feature known to a few pixels, fewer others compete with the right one, and more
matches pass Lowe's ratio (COLMAP's guided matching, with its thresholds). The squared distances of
all descriptors of two photos are one product of whole numbers below 2^24, which float32 holds
exactly: the same on every machine, in whatever order it is summed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.pose.colmap.epipolar import Constraint

Float32 = npt.NDArray[np.float32]

#: COLMAP's: the best must be nearer than this part of the distance to the second best (Lowe).
LARGEST_RATIO = 0.8
#: COLMAP's: the largest distance of two descriptors, whose length is about 512.
LARGEST_DISTANCE = 0.7 * 512.0
#: Features of the first photo compared at a time with all of the second: bounds memory at 16 MiB
#: per buffer and 8192 features, and keeps a block near the processor.
ROWS_AT_ONCE = 512


@dataclass(frozen=True)
class Features:
    """Features of a photo, ready for comparison with those of others.

    Attributes:
        xy: float32 [N, 2], pixels.
        left: float32 [N, 130], right: float32 [N, 130]: the product of a row of ``left`` and a row
            of another photo's ``right`` is minus the squared distance of their descriptors.
    """

    xy: Float32
    left: Float32
    right: Float32


def comparable(xy: npt.ArrayLike, descriptors: npt.NDArray[np.uint8]) -> Features:
    """Features at places [N, 2] in pixels, with descriptors uint8 [N, 128]."""
    numbers = descriptors.astype(np.float32).reshape(-1, 128)
    squared = (numbers * numbers).sum(axis=1, keepdims=True)
    one = np.ones_like(squared)
    return Features(
        np.asarray(xy, dtype=np.float32).reshape(-1, 2),
        np.hstack([2.0 * numbers, -squared, one]).astype(np.float32),
        np.hstack([numbers, one, -squared]).astype(np.float32),
    )


def guided_matches(
    first: Features, second: Features, constraint: Constraint
) -> npt.NDArray[np.uint32]:
    """Pairs of features that are each other's clear best among those where the geometry allows.

    Args:
        first: features of one photo.
        second: of another.
        constraint: from the first photo to the second.

    Returns:
        Indices into both, uint32 [M, 2], by the first; no feature is in two pairs.
    """
    best, clear = _clear_best(first, second, constraint)
    candidates = np.flatnonzero(clear)
    partners = best[candidates]
    asked = Features(second.xy[partners], second.left[partners], second.right[partners])
    back, clear = _clear_best(asked, first, constraint.reversed())
    mutual = clear & (back == candidates)
    return np.stack([candidates[mutual], partners[mutual]], axis=1).astype(np.uint32)


def _clear_best(
    first: Features, second: Features, constraint: Constraint
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Of each of ``first`` the most similar of ``second``, and whether it is clearly so; both [N].

    Only features where ``constraint`` allows compete.
    """
    count, others = len(first.xy), len(second.xy)
    best = np.zeros(count, dtype=np.int64)
    clear = np.zeros(count, dtype=bool)
    if not others:
        return best, clear
    buffer = np.empty((min(count, ROWS_AT_ONCE), others), dtype=np.float32)
    for start in range(0, count, ROWS_AT_ONCE):
        some = slice(start, min(start + ROWS_AT_ONCE, count))
        rows = np.arange(some.stop - some.start)
        near = np.matmul(first.left[some], second.right.T, out=buffer[: len(rows)])
        constraint.forbid(first.xy[some], second.xy, near)
        best[some] = near.argmax(axis=1)
        nearest = near[rows, best[some]]
        near[rows, best[some]] = -np.inf
        # Of squared distances, both limits are squared.
        clear[some] = (nearest >= -(LARGEST_DISTANCE**2)) & (
            nearest > LARGEST_RATIO**2 * near.max(axis=1)
        )
    return best, clear
