"""Depths of a photo's pixels from what several edges say of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

#: Rounds of re-weighting.
ROUNDS = 10
#: Numbers worked on at once: bounds memory, and should stay in a core's cache.
CHUNK = 200_000
#: Distances below this part of the depth weigh no more.
NO_DISTANCE = 1e-7


def depths_on_rays(
    points: npt.NDArray[Any], weights: npt.NDArray[Any], slopes: npt.NDArray[Any]
) -> npt.NDArray[np.float64]:
    """Depths [P] with the least weighted sum of distances from points on rays to given points.

    That is what the alignment minimises, for one pixel while all else is held. NaN where all
    weights are 0. By Weiszfeld's re-weighting.

    Args:
        points: [K, 3, P], in the camera frame.
        weights: [K, P], not negative.
        slopes: [2, P], (x, y) of the rays (x, y, 1).
    """
    result = np.empty(points.shape[2])
    step = max(1, CHUNK // (3 * len(points)))
    for begin in range(0, points.shape[2], step):
        part = slice(begin, begin + step)
        given = torch.from_numpy(points[:, :, part].astype(np.float32))
        constant = torch.from_numpy(weights[:, part].astype(np.float32))
        x, y = torch.from_numpy(slopes[:, part].astype(np.float32))
        ray = torch.stack([x, y, torch.ones_like(x)])
        along, length = (given * ray).sum(dim=1), ray.square().sum(dim=0)
        weight = constant
        for _ in range(ROUNDS):
            depth = (weight * along).sum(dim=0) / (weight.sum(dim=0) * length)
            off = (depth * ray - given).square_().sum(dim=1).sqrt_()
            weight = constant / torch.maximum(off, NO_DISTANCE * depth.abs() + 1e-30)
        result[part] = depth.numpy()
    return result
