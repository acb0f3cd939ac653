"""Where a feature of one photo may be in another, by the geometry of the two."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


class Constraint(Protocol):
    """What the geometry of two photos says about where features correspond."""

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        """Set scores [N, M] to minus infinity where places [N, 2] and [M, 2] cannot correspond."""

    def reversed(self) -> Constraint:
        """The constraint from the second photo to the first."""


@dataclass(frozen=True)
class EpipolarLine:
    """Correspondences lie on each other's epipolar lines, to a Sampson distance in pixels.

    Attributes:
        F: fundamental matrix, float64 [3, 3]: second^T F first = 0.
        pixels: the largest distance.
    """

    F: Float64
    pixels: float

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        lines, others = _homogeneous(first) @ self.F.T, _homogeneous(second) @ self.F
        # Of equations of size one, the squares stay within float32.
        size = np.sqrt(np.mean(lines[:, :2] ** 2) + np.mean(others[:, :2] ** 2))
        lines, others = lines / max(size, 1e-300), others / max(size, 1e-300)
        # No matrix product: of three columns, handing it to threads takes longer than it.
        a, b, c = (column[:, None] for column in lines.astype(np.float32).T)
        x, y = second.T
        off = a * x
        off += b * y
        off += c
        np.multiply(off, off, out=off)
        limit = self.pixels**2
        slopes = (limit * (lines[:, :2] ** 2).sum(axis=1)).astype(np.float32)
        other_slopes = (limit * (others[:, :2] ** 2).sum(axis=1)).astype(np.float32)
        off -= slopes[:, None]
        np.copyto(scores, -np.inf, where=off > other_slopes)

    def reversed(self) -> EpipolarLine:
        return EpipolarLine(self.F.T, self.pixels)


@dataclass(frozen=True)
class Plane:
    """Correspondences are images of each other by a homography, to a distance in pixels.

    Attributes:
        H: homography, float64 [3, 3].
        pixels: the largest distance, in the photo that it maps to.
        back: whether it maps from the second photo to the first.
    """

    H: Float64
    pixels: float
    back: bool = False

    def forbid(self, first: Float32, second: Float32, scores: Float32) -> None:
        source, target = (second, first) if self.back else (first, second)
        mapped = _homogeneous(source) @ self.H.T
        with np.errstate(divide="ignore", invalid="ignore"):
            places = (mapped[:, :2] / mapped[:, 2:]).astype(np.float32)
        if self.back:
            places, target = target, places
        off = np.square(places[:, None, 0] - target[None, :, 0])
        off += np.square(places[:, None, 1] - target[None, :, 1])
        # What is mapped to no place is off by no number.
        np.copyto(scores, -np.inf, where=~(off <= self.pixels**2))

    def reversed(self) -> Plane:
        return Plane(self.H, self.pixels, not self.back)


def _homogeneous(places: Float32) -> Float64:
    return np.hstack([places.astype(np.float64), np.ones((len(places), 1))])
