"""What a network says about pairs of photos: the seam between prediction and alignment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from igsr.capture.photo_folder import Photo


@dataclass(frozen=True, eq=False)
class PairPrediction:
    """The pointmaps of an ordered pair of photos, both in the camera frame of the first.

    Attributes:
        first, second: indices of the photos.
        first_points: float32 [h, w, 3], on the grid of photo ``first``; OpenCV axes, a scale of
            the pair's own.
        first_confidence: float32 [h, w], raw, 1 or more; 1 says nothing is known.
        second_points: float32 [h2, w2, 3], on the grid of photo ``second``, same frame and scale.
        second_confidence: float32 [h2, w2].
    """

    first: int
    second: int
    first_points: np.ndarray
    first_confidence: np.ndarray
    second_points: np.ndarray
    second_confidence: np.ndarray


@dataclass(frozen=True)
class Grid:
    """How a photo's prediction grid lies in the photo.

    Pixel coordinates have centres at +0.5 on both sides:
    photo = grid * (scale_x, scale_y) + (offset_x, offset_y).
    """

    height: int
    width: int
    scale_x: float
    scale_y: float
    offset_x: float
    offset_y: float


class Predictor(Protocol):
    """What stands where the network stands."""

    def __call__(
        self,
        photos: Sequence[Photo],
        pairs: Sequence[tuple[int, int]],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> tuple[list[Grid], list[PairPrediction]]:
        """A grid per photo and a prediction per pair, in the pairs' order."""
        ...
