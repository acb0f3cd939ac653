"""Depths of all pixels of a photo once the cameras and edges are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from .observations import usable_confidence
from .predictions import PairPrediction

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

#: Rounds of re-weighting.
ROUNDS = 10
#: Numbers worked on at once: bounds memory.
CHUNK = 300_000
#: Distances below this part of the depth weigh no more.
NO_DISTANCE = 1e-7


@dataclass(frozen=True, eq=False)
class EdgeToCamera:
    """From the frame of a prediction to that of a camera.

    Attributes:
        prediction: of an edge that the photo is on.
        is_first: whether it is the prediction's first photo.
        matrix: float64 [3, 4].
    """

    prediction: PairPrediction
    is_first: bool
    matrix: Float64


def dense_depth(
    edges: Sequence[EdgeToCamera], pixels: Float64, K: Float64
) -> tuple[Float32, Float32]:
    """Depth and raw confidence, float32 [h, w], of every pixel of a photo's grid.

    The depth is what minimises the alignment's objective while all else is held; the confidence is
    the greatest of all edges. NaN and 1 where no edge says anything of a pixel.

    Args:
        edges: those that the photo is on.
        pixels: [h * w, 2], photo coordinates of the grid.
        K: [3, 3], pixels of the photo.
    """
    maps = [
        (p.first_points, p.first_confidence)
        if edge.is_first
        else (p.second_points, p.second_confidence)
        for edge in edges
        for p in (edge.prediction,)
    ]
    confidences = [usable_confidence(points, confidence).ravel() for points, confidence in maps]
    flat = [points.reshape(-1, 3) for points, _ in maps]
    slopes = ((pixels - K[[0, 1], 2]) / K[[0, 1], [0, 1]]).astype(np.float32)
    rays = torch.from_numpy(np.column_stack([slopes, np.ones_like(slopes[:, :1])]))
    result, best = np.empty(len(pixels), np.float32), np.empty(len(pixels), np.float32)
    step = max(1, CHUNK // (3 * len(edges)))
    for begin in range(0, len(pixels), step):
        part = slice(begin, begin + step)
        confidence = np.stack([c[part] for c in confidences])
        points = np.stack(
            [
                np.where(c[part, None] > 1.0, p[part], np.float32(0.0)) @ edge.matrix[:, :3].T
                + edge.matrix[:, 3]
                for edge, p, c in zip(edges, flat, confidences, strict=True)
            ]
        )
        depth = _along_rays(
            torch.from_numpy(points).float(), torch.from_numpy(confidence).log(), rays[part]
        )
        result[part], best[part] = depth.numpy(), confidence.max(axis=0)
    result[~(result > 0.0)] = np.nan
    size = maps[0][1].shape
    return result.reshape(size), best.reshape(size)


def _along_rays(points: Tensor, weights: Tensor, rays: Tensor) -> Tensor:
    """Depths [P] on rays [P, 3], least in weighted sum of distances to points [K, P, 3]."""
    along, lengths = (points * rays).sum(dim=2), rays.square().sum(dim=1)
    distance_weights = weights
    for _ in range(ROUNDS):
        total = distance_weights.sum(dim=0)
        depth = (distance_weights * along).sum(dim=0) / (total * lengths)
        off = (depth[:, None] * rays - points).square().sum(dim=2).sqrt_()
        distance_weights = weights / off.clamp(min=NO_DISTANCE * depth.abs().clamp(min=1e-20))
    return depth
