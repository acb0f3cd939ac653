"""A photo's camera from points in the world and their pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture.types import intrinsic_matrix

Float64 = npt.NDArray[np.float64]

#: Points used; more cost time and tell no more.
POINTS = 1000
#: Part of the photo's longer side that a point may be off (5 of 512 pixels, as in DUSt3R).
MAX_ERROR = 0.01
#: Samples drawn at most; of points of which a fifth are right, one in 125 is right as a whole.
TRIALS = 1000
#: Focal lengths tried where none is known, and their range in units of the photo's longer side.
FOCALS, SHORTEST, LONGEST = 21, 0.5, 3.0


def absolute_pose(
    points: Float64,
    pixels: Float64,
    confidence: Float64,
    K: Float64,
    size: tuple[int, int],
    seed: int,
) -> tuple[Float64, int] | None:
    """World-to-camera [4, 4] and how many points agree with it, or None.

    Perspective-n-point in RANSAC, then refined (pycolmap), from the most confident points.

    Args:
        points: [3, N], world frame.
        pixels: [N, 2], photo coordinates with pixel centres at +0.5.
        confidence: [N], 1 where a point is not to be used.
        K: [3, 3], pixels.
        size: height and width of the photo.
        seed: what draws the samples.
    """
    # It takes longer to load than all of igsr.
    import pycolmap

    order = np.argsort(-confidence, kind="stable")[: np.count_nonzero(confidence > 1.0)]
    # The better half, evenly: the best alone may lie on one small thing.
    order = order[: max(len(order) // 2, min(len(order), POINTS))]
    order = order[:: max(1, len(order) // POINTS)]
    if len(order) < 4:
        return None
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=size[1],
        height=size[0],
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )
    options: Any = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = MAX_ERROR * max(size)
    options.ransac.max_num_trials = TRIALS
    options.ransac.random_seed = seed
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    try:
        found = pycolmap.estimate_and_refine_absolute_pose(
            pixels[order], points[:, order].T, camera, options
        )
    finally:
        pycolmap.logging.minloglevel = level
    if found is None:
        return None
    viewmat = np.eye(4)
    viewmat[:3] = found["cam_from_world"].matrix()
    return (viewmat, int(found["num_inliers"])) if np.isfinite(viewmat).all() else None


def searched_focal(
    points: Float64,
    pixels: Float64,
    confidence: Float64,
    size: tuple[int, int],
    seed: int,
) -> tuple[float, int] | None:
    """The focal length in pixels that most points agree with, and how many, or None.

    Args:
        points, pixels, confidence, size, seed: as for ``absolute_pose``.
    """
    height, width = size
    best: tuple[float, int] | None = None
    for focal in max(size) * np.geomspace(SHORTEST, LONGEST, FOCALS):
        K = intrinsic_matrix(focal, focal, width / 2, height / 2)
        found = absolute_pose(points, pixels, confidence, K, size, seed)
        if found is not None and (best is None or found[1] > best[1]):
            best = float(focal), found[1]
    return best
