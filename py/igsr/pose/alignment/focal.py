"""The focal length that a pointmap in its own camera frame was seen with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

#: Rounds of re-weighting.
ROUNDS = 50
#: A change of the focal length, relative, that ends the rounds.
SETTLED = 1e-9
#: Distances in pixels below this weigh no more.
NO_DISTANCE = 1e-6


def weiszfeld_focal(points: Float64, offsets: Float64, weights: Float64) -> float | None:
    """The focal length with the least weighted sum of distances, in pixels.

    Minimises sum_p weights_p || offsets_p - f (x_p, y_p) / z_p ||, by Weiszfeld's algorithm as
    DUSt3R does (Wang et al. 2024, section 3.3).

    Args:
        points: [3, N], in the camera frame; those not in front of the camera are left out.
        offsets: [N, 2], pixel coordinates relative to the principal point.
        weights: [N], not negative.

    Returns:
        None where no point says anything, or the points are mirrored.
    """
    used = (points[2] > 0.0) & (weights > 0.0)
    with np.errstate(over="ignore", divide="ignore"):
        slopes = (points[:2, used] / points[2, used]).T
    finite = np.isfinite(slopes).all(axis=1)
    slopes, offsets, weights = slopes[finite], offsets[used][finite], weights[used][finite]
    focal, distance_weights = 0.0, weights
    for _ in range(ROUNDS):
        across = distance_weights @ (slopes * slopes).sum(axis=1)
        if not across > 0.0:
            return None
        before, focal = focal, float(distance_weights @ (slopes * offsets).sum(axis=1) / across)
        if abs(focal - before) <= SETTLED * abs(focal):
            break
        off = np.linalg.norm(offsets - focal * slopes, axis=1)
        distance_weights = weights / np.maximum(off, NO_DISTANCE)
    return focal if np.isfinite(focal) and focal > 0.0 else None
