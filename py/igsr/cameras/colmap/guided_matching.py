"""Match features along epipolar lines, by a matrix product of SIFT descriptors.

If the position of a feature is known to a few pixels, fewer candidates compete and more matches
pass Lowe's ratio test (COLMAP's guided matching, with its thresholds). Neighboring features share
most candidates, so batches of neighbors are compared with few features. The squared distances of
descriptors are a product of integers below 2^24, which float32 represents exactly, so that the
result does not depend on the order of summation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

#: Lowe's ratio: maximum distance to the best match over that to the second best, as COLMAP.
MAX_RATIO = 0.8
#: Maximum distance between descriptors of length 512, as COLMAP.
MAX_DISTANCE = 0.7 * 512.0
#: Features of the first photo in a batch.
BATCH_FEATURES = 256
#: Candidates of a batch may be farther by this factor than matches, because of rounding.
MARGIN = 1.01

#: Indices of features of the first photo, and of their candidates in the second, ascending.
Batch: TypeAlias = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]


class Constraint(Protocol):
    """Constrains where the features of two photos can correspond."""

    def batches(self, first: Float32, second: Float32) -> Iterator[Batch]:
        """Group places [N, 2] of all features, with their candidates among places [M, 2]."""

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        """Set scores [N, M] to -inf for places [N, 2] and [M, 2] that cannot correspond."""

    def reversed(self) -> Constraint:
        """The constraint from the second photo to the first."""


@dataclass(frozen=True)
class EpipolarLine:
    """Correspondences lie on each other's epipolar lines."""

    F: Float64  # fundamental matrix [3, 3]: second^T F first = 0
    pixels: float  # maximum Sampson distance

    def batches(self, first: Float32, second: Float32) -> Iterator[Batch]:
        # Lines are s_i (cos(t_i) u + sin(t_i) v). The error of a feature is a sinusoid of t: among
        # neighboring lines it is smallest at the first or the last unless its sign changes.
        u, v = np.linalg.svd(self.F)[0][:, :2].T
        lines = _homogeneous(first) @ self.F.T
        along_u, along_v = lines @ u, lines @ v
        angles = np.arctan2(along_v, along_u) % np.pi
        sizes = np.hypot(along_u, along_v)
        errors = _homogeneous(second) @ np.column_stack([u, v])
        other_slopes = ((_homogeneous(second) @ self.F)[:, :2] ** 2).sum(axis=1)
        for rows in _groups(angles):
            ends = angles[rows[[0, -1]]]
            at_ends = errors @ np.stack([np.cos(ends), np.sin(ends)])
            size = max(sizes[rows].min(), 1e-300)
            slopes = (lines[rows, :2] / np.maximum(sizes[rows], 1e-300)[:, None]) ** 2
            limit = slopes.sum(axis=1).max() + other_slopes / size**2
            near = (at_ends**2).min(axis=1) <= MARGIN * self.pixels**2 * limit
            yield rows, np.flatnonzero(near | (at_ends[:, 0] * at_ends[:, 1] <= 0.0))

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

    def batches(self, first: Float32, second: Float32) -> Iterator[Batch]:
        places, others = self._in_one_photo(first, second)
        for rows in _groups(places[:, 0]):
            low, high = places[rows[[0, -1]], 0] + self.pixels * np.array([-MARGIN, MARGIN])
            yield rows, np.flatnonzero((others[:, 0] >= low) & (others[:, 0] <= high))

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        places, others = self._in_one_photo(first, second)
        distance = np.square(places[:, None, 0] - others[None, :, 0])
        distance += np.square(places[:, None, 1] - others[None, :, 1])
        # "not <=", since places may be NaN.
        np.copyto(scores, -np.inf, where=~(distance <= self.pixels**2))

    def _in_one_photo(self, first: Float32, second: Float32) -> tuple[Float32, Float32]:
        """Both places as seen in the target photo."""
        mapped = _homogeneous(second if self.back else first) @ self.H.T
        with np.errstate(divide="ignore", invalid="ignore"):
            places = (mapped[:, :2] / mapped[:, 2:]).astype(np.float32)
        return (first, places) if self.back else (places, second)

    def reversed(self) -> Plane:
        return Plane(self.H, self.pixels, not self.back)


def _homogeneous(places: Float32) -> Float64:
    return np.hstack([places.astype(np.float64), np.ones((len(places), 1))])


def _groups(values: npt.NDArray[np.floating]) -> Iterator[npt.NDArray[np.int64]]:
    """Indices of ``BATCH_FEATURES`` values at a time, in ascending order of the values."""
    order = np.argsort(values, kind="stable")
    for start in range(0, len(order), BATCH_FEATURES):
        yield order[start : start + BATCH_FEATURES]


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
    # Learned keypoints follow SIFT's and have no descriptors.
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
    best = np.zeros(len(first.xy), dtype=np.int64)
    passed = np.zeros(len(first.xy), dtype=bool)
    for batch, candidates in constraint.batches(first.xy, second.xy):
        if not len(candidates):
            continue
        rows = np.arange(len(batch))
        scores = first.left[batch] @ second.right[candidates].T
        constraint.forbid(first.xy[batch], second.xy[candidates], scores)
        nearest = scores.argmax(axis=1)
        best[batch] = candidates[nearest]
        highest = scores[rows, nearest]
        scores[rows, nearest] = -np.inf
        # Scores are negative squared distances.
        passed[batch] = (highest >= -(MAX_DISTANCE**2)) & (
            highest > MAX_RATIO**2 * scores.max(axis=1)
        )
    return best, passed
