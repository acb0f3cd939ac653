"""Match features along epipolar lines, by a matrix product of SIFT descriptors.

If the position of a feature is known to a few pixels, fewer candidates compete and more matches
pass Lowe's ratio test (COLMAP's guided matching, with its thresholds). The squared distances of all
descriptors are a product of integers below 2^24, which float32 represents exactly, so that the
result does not depend on the order of summation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

#: Lowe's ratio: maximum distance to the best match over that to the second best, as COLMAP.
MAX_RATIO = 0.8
#: Maximum distance between descriptors of length 512, as COLMAP.
MAX_DISTANCE = 0.7 * 512.0
#: Features of the first photo in a batch; bounds a buffer for 8192 features to 16 MiB.
BATCH_FEATURES = 512


class Constraint(Protocol):
    """Constrains where the features of two photos can correspond."""

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        """Set scores [N, M] to -inf for places [N, 2] and [M, 2] that cannot correspond."""

    def reversed(self) -> Constraint:
        """The constraint from the second photo to the first."""


@dataclass(frozen=True)
class EpipolarLine:
    """Correspondences lie on each other's epipolar lines."""

    F: Float64  # fundamental matrix [3, 3]: second^T F first = 0
    pixels: float  # maximum Sampson distance

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        lines, others = _homogeneous(first) @ self.F.T, _homogeneous(second) @ self.F
        # Normalized, so that squares stay within float32.
        size = np.sqrt(np.mean(lines[:, :2] ** 2) + np.mean(others[:, :2] ** 2))
        lines, others = lines / max(size, 1e-300), others / max(size, 1e-300)
        # A matrix product of three columns would mostly wait for threads.
        a, b, c = (column[:, None] for column in lines.astype(np.float32).T)
        x, y = second.T
        error = a * x
        error += b * y
        error += c
        np.multiply(error, error, out=error)
        limit = self.pixels**2
        slopes = (limit * (lines[:, :2] ** 2).sum(axis=1)).astype(np.float32)
        other_slopes = (limit * (others[:, :2] ** 2).sum(axis=1)).astype(np.float32)
        error -= slopes[:, None]
        np.copyto(scores, -np.inf, where=error > other_slopes)

    def reversed(self) -> EpipolarLine:
        return EpipolarLine(self.F.T, self.pixels)


@dataclass(frozen=True)
class Plane:
    """Correspondences are mapped to each other by a homography."""

    H: Float64  # [3, 3]
    pixels: float  # maximum distance in the target photo
    back: bool = False  # whether it maps from the second photo to the first

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        source, target = (second, first) if self.back else (first, second)
        mapped = _homogeneous(source) @ self.H.T
        with np.errstate(divide="ignore", invalid="ignore"):
            places = (mapped[:, :2] / mapped[:, 2:]).astype(np.float32)
        if self.back:
            places, target = target, places
        distance = np.square(places[:, None, 0] - target[None, :, 0])
        distance += np.square(places[:, None, 1] - target[None, :, 1])
        # "not <=", since places may be NaN.
        np.copyto(scores, -np.inf, where=~(distance <= self.pixels**2))

    def reversed(self) -> Plane:
        return Plane(self.H, self.pixels, not self.back)


def _homogeneous(places: Float32) -> Float64:
    return np.hstack([places.astype(np.float64), np.ones((len(places), 1))])


@dataclass(frozen=True)
class Features:
    """Features of a photo, prepared for comparison.

    The product of a row of ``left`` and a row of another photo's ``right`` is the negative squared
    distance of their descriptors.
    """

    xy: Float32  # [N, 2], pixels
    left: Float32  # [N, 130]
    right: Float32  # [N, 130]


def comparable(xy: npt.ArrayLike, descriptors: npt.NDArray[np.uint8]) -> Features:
    """Prepare features at places [N, 2] in pixels, with descriptors uint8 [N, 128]."""
    # Keypoints of other matchers follow those with descriptors.
    xy = np.asarray(xy, dtype=np.float32).reshape(-1, 2)[: len(descriptors)]
    numbers = descriptors.astype(np.float32).reshape(-1, 128)
    squared = (numbers * numbers).sum(axis=1, keepdims=True)
    one = np.ones_like(squared)
    return Features(
        xy,
        np.hstack([2.0 * numbers, -squared, one]).astype(np.float32),
        np.hstack([numbers, one, -squared]).astype(np.float32),
    )


def guided_matches(
    first: Features, second: Features, constraint: Constraint
) -> npt.NDArray[np.uint32]:
    """Match features that are each other's best within a constraint and pass the ratio test.

    Returns:
        Indices into both, uint32 [M, 2], ascending in the first, none twice.
    """
    best, passed = _best(first, second, constraint)
    candidates = np.flatnonzero(passed)
    partners = best[candidates]
    matched = Features(second.xy[partners], second.left[partners], second.right[partners])
    back, passed = _best(matched, first, constraint.reversed())
    mutual = passed & (back == candidates)
    return np.stack([candidates[mutual], partners[mutual]], axis=1).astype(np.uint32)


def _best(
    first: Features, second: Features, constraint: Constraint
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """The best match [N] of each first feature, and whether it passes the tests [N]."""
    count, others = len(first.xy), len(second.xy)
    best = np.zeros(count, dtype=np.int64)
    passed = np.zeros(count, dtype=bool)
    if not others:
        return best, passed
    buffer = np.empty((min(count, BATCH_FEATURES), others), dtype=np.float32)
    for start in range(0, count, BATCH_FEATURES):
        batch = slice(start, min(start + BATCH_FEATURES, count))
        rows = np.arange(batch.stop - batch.start)
        scores = np.matmul(first.left[batch], second.right.T, out=buffer[: len(rows)])
        constraint.forbid(first.xy[batch], second.xy, scores)
        best[batch] = scores.argmax(axis=1)
        highest = scores[rows, best[batch]]
        scores[rows, best[batch]] = -np.inf
        # Scores are negative squared distances.
        passed[batch] = (highest >= -(MAX_DISTANCE**2)) & (
            highest > MAX_RATIO**2 * scores.max(axis=1)
        )
    return best, passed
