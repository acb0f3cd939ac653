"""Estimate the pose, focal length and depths of one photo from points."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.alignment.predictions import Observations, PhotoToAlign
from igsr.capture.types import intrinsic_matrix

Float64 = npt.NDArray[np.float64]
#: Points [3, P] and their raw confidence [P].
Placed = tuple[Float64, Float64]

#: Maximum number of points for a pose; more cost time and change little.
MAX_POSE_POINTS = 1000
#: Maximum error of inliers, as a fraction of the photo's longer side (5 of 512 pixels, as DUSt3R).
MAX_POSE_ERROR = 0.01
#: Maximum number of RANSAC trials; with a fifth of the points right, one sample in 125 is.
MAX_RANSAC_TRIALS = 1000
#: Focal lengths that are tried if none can be estimated, in units of the photo's longer side.
TRIED_FOCALS = np.geomspace(0.5, 3.0, 21)
#: Maximum number of re-weightings for a focal length, and the relative change that ends them.
FOCAL_ITERATIONS = 50
FOCAL_TOLERANCE = 1e-9
#: Minimum distance in the weights for a focal length, pixels.
MIN_FOCAL_DISTANCE = 1e-6
#: Number of re-weightings for depths.
DEPTH_ITERATIONS = 10
#: Minimum distance in the weights for depths, as a fraction of the depth.
MIN_DEPTH_DISTANCE = 1e-7
#: Numbers in a batch; they should fit into a core's cache.
BATCH_NUMBERS = 200_000


def absolute_pose(
    points: Float64,
    pixels: Float64,
    confidence: Float64,
    K: Float64,
    size: tuple[int, int],
    seed: int,
) -> tuple[Float64, int] | None:
    """Estimate a pose from points and their pixels, by RANSAC and refinement (pycolmap).

    Args:
        points: [3, N], world frame.
        pixels: [N, 2], photo coordinates with pixel centers at +0.5.
        confidence: [N], 1 for points that must not be used.
        K: [3, 3], pixels.
        size: height and width of the photo.
        seed: of RANSAC.

    Returns:
        World-to-camera [4, 4] and the number of inliers; None if no pose is found.
    """
    # Slow to import.
    pycolmap = load_pycolmap()
    order = np.argsort(-confidence, kind="stable")[: np.count_nonzero(confidence > 1.0)]
    # The better half, evenly: the best points may all lie on one small object.
    order = order[: max(len(order) // 2, min(len(order), MAX_POSE_POINTS))]
    order = order[:: max(1, len(order) // MAX_POSE_POINTS)]
    if len(order) < 4:
        return None
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=size[1],
        height=size[0],
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )
    options: Any = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = MAX_POSE_ERROR * max(size)
    options.ransac.max_num_trials = MAX_RANSAC_TRIALS
    options.ransac.random_seed = seed
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    try:
        estimate = pycolmap.estimate_and_refine_absolute_pose(
            pixels[order], points[:, order].T, camera, options
        )
    finally:
        pycolmap.logging.minloglevel = level
    if estimate is None:
        return None
    viewmat = np.eye(4)
    viewmat[:3] = estimate["cam_from_world"].matrix()
    return (viewmat, int(estimate["num_inliers"])) if np.isfinite(viewmat).all() else None


def searched_focal(
    points: Float64, pixels: Float64, confidence: Float64, size: tuple[int, int], seed: int
) -> tuple[float, int] | None:
    """The focal length in pixels for which ``absolute_pose`` has the most inliers, and these."""
    height, width = size
    best: tuple[float, int] | None = None
    for focal in max(size) * TRIED_FOCALS:
        K = intrinsic_matrix(focal, focal, width / 2, height / 2)
        pose = absolute_pose(points, pixels, confidence, K, size, seed)
        if pose is not None and (best is None or pose[1] > best[1]):
            best = float(focal), pose[1]
    return best


def weiszfeld_focal(points: Float64, offsets: Float64, weights: Float64) -> float | None:
    """Estimate the focal length of a pointmap in its own camera frame.

    Minimizes sum_p weights_p || offsets_p - f (x_p, y_p) / z_p ||, by Weiszfeld's algorithm as
    DUSt3R does (Wang et al. 2024, section 3.3).

    Args:
        points: [3, N], in the camera frame; those behind the camera are ignored.
        offsets: [N, 2], pixel coordinates relative to the principal point.
        weights: [N], not negative.

    Returns:
        Pixels; None if no point has a weight, or the points are mirrored.
    """
    used = (points[2] > 0.0) & (weights > 0.0)
    with np.errstate(over="ignore", divide="ignore"):
        slopes = (points[:2, used] / points[2, used]).T
    finite = np.isfinite(slopes).all(axis=1)
    slopes, offsets, weights = slopes[finite], offsets[used][finite], weights[used][finite]
    focal, distance_weights = 0.0, weights
    for _ in range(FOCAL_ITERATIONS):
        across = distance_weights @ (slopes * slopes).sum(axis=1)
        if not across > 0.0:
            return None
        before, focal = focal, float(distance_weights @ (slopes * offsets).sum(axis=1) / across)
        if abs(focal - before) <= FOCAL_TOLERANCE * abs(focal):
            break
        distance = np.linalg.norm(offsets - focal * slopes, axis=1)
        distance_weights = weights / np.maximum(distance, MIN_FOCAL_DISTANCE)
    return focal if np.isfinite(focal) and focal > 0.0 else None


def intrinsics_of(
    observations: Observations,
    photos: Sequence[PhotoToAlign],
    placed: Mapping[int, Placed],
    seed: int,
) -> dict[int, Float64]:
    """Estimate the initial intrinsics [3, 3] of photos; unknown ones are left out.

    The focal length of a group comes from the pointmaps of its photos, each in the photo's own
    frame on its best edge. Without these, focal lengths are tried, and the one with the most
    inliers in any of its photos is taken. ``placed`` has the points of each photo in the world.
    """
    groups: dict[Hashable, list[int]] = {}
    result = {}
    for photo in observations.photos:
        known = photos[photo].intrinsics
        if known is None:
            groups.setdefault(photos[photo].group, []).append(photo)
        else:
            result[photo] = known
    for members in groups.values():
        focal = _focal_of_group(observations, photos, members)
        if focal is None:
            searched = [
                searched_focal(
                    placed[i][0],
                    observations.photos[i].pixels,
                    placed[i][1],
                    (photos[i].height, photos[i].width),
                    seed,
                )
                for i in members
            ]
            best = max((one for one in searched if one), key=lambda one: one[1], default=None)
            focal = None if best is None else best[0]
        if focal is not None:
            result |= {photo: photos[photo].centered(focal) for photo in members}
    return result


def _focal_of_group(
    observations: Observations, photos: Sequence[PhotoToAlign], members: Sequence[int]
) -> float | None:
    parts = []
    for photo in members:
        own = np.flatnonzero(observations.edges[:, 0] == photo)
        if len(own):
            e = int(own[np.argmax(observations.scores[own])])
            xyz, confidence = observations.side(e, 0)
            center = [photos[photo].width / 2, photos[photo].height / 2]
            offsets = observations.photos[photo].pixels - center
            parts.append((xyz - observations.camera(e)[:, None], offsets, np.log(confidence)))
    if not parts:
        return None
    points, all_offsets, weights = (list(column) for column in zip(*parts, strict=True))
    return weiszfeld_focal(
        np.concatenate(points, axis=1), np.concatenate(all_offsets), np.concatenate(weights)
    )


def depths_on_rays(
    points: npt.NDArray[Any], weights: npt.NDArray[Any], slopes: npt.NDArray[Any]
) -> Float64:
    """Estimate the depths with the least weighted sum of distances to points, by Weiszfeld.

    This is the objective of the alignment for one pixel with everything else fixed.

    Args:
        points: [K, 3, P], in the camera frame.
        weights: [K, P], not negative.
        slopes: [2, P], (x, y) of the rays (x, y, 1).

    Returns:
        [P], NaN for pixels without a weight.
    """
    result = np.empty(points.shape[2])
    step = max(1, BATCH_NUMBERS // (3 * len(points)))
    for begin in range(0, points.shape[2], step):
        part = slice(begin, begin + step)
        targets = torch.from_numpy(points[:, :, part].astype(np.float32))
        constant = torch.from_numpy(weights[:, part].astype(np.float32))
        x, y = torch.from_numpy(slopes[:, part].astype(np.float32))
        ray = torch.stack([x, y, torch.ones_like(x)])
        along, length = (targets * ray).sum(dim=1), ray.square().sum(dim=0)
        weight = constant
        for _ in range(DEPTH_ITERATIONS):
            depth = (weight * along).sum(dim=0) / (weight.sum(dim=0) * length)
            distance = (depth * ray - targets).square_().sum(dim=1).sqrt_()
            weight = constant / torch.maximum(distance, MIN_DEPTH_DISTANCE * depth.abs() + 1e-30)
        result[part] = depth.numpy()
    return result
