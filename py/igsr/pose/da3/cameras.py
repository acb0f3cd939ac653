"""Cameras of Depth Anything 3: pose encodings, and cameras from rays (arXiv 2511.10647, section 3).

A pose encoding is (t, q, fov_h, fov_w): the camera's center in the world, its camera-to-world
rotation as a quaternion (x, y, z, w) of any length, and the vertical and horizontal field of view
in radians. The principal point is the center of the image. Axes are OpenCV's; pixels have their
centers at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr._internal.rotations import rotations_of
from igsr.capture.types import intrinsic_matrix
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Minimum tangent of half a field of view.
MIN_TANGENT = 1e-6
#: Minimum unit of known cameras.
MIN_UNIT = 0.1
#: Fraction of the rays, the most confident ones, that RANSAC samples from.
SAMPLED_FRACTION = 0.3
#: Number of RANSAC samples, and of rays in each.
SAMPLES = 100
SAMPLE_RAYS = 8
#: Maximum distance of inliers, on an image plane of 2 x 2.
MAX_INLIER_DISTANCE = 0.2
#: Minimum z of a ray in the world; with less, its point on the plane is not defined.
MIN_RAY_Z = 1e-4


def decode_pose(
    encoding: npt.ArrayLike | Tensor, height: int, width: int
) -> tuple[Float64, Float64]:
    """Convert pose encodings [S, 9] to world-to-camera [S, 3, 4] and intrinsics [S, 3, 3], pixels.

    A field of view of 0, or of pi and more, gives a focal length of 500 000 sides.
    """
    numbers = _numpy(encoding)
    # w comes last.
    center, c2w = numbers[:, :3], rotations_of(np.roll(_unit(numbers[:, 3:7]), 1, axis=-1))
    tangents = np.maximum(np.tan(numbers[:, 7:] / 2.0), MIN_TANGENT)
    focal_y, focal_x = (height / 2.0) / tangents[:, 0], (width / 2.0) / tangents[:, 1]
    intrinsics = [
        intrinsic_matrix(float(fx), float(fy), width / 2.0, height / 2.0)
        for fx, fy in zip(focal_x, focal_y, strict=True)
    ]
    return _w2c(c2w, center), np.stack(intrinsics)


def encode_pose(
    viewmats: npt.ArrayLike | Tensor,
    intrinsics: npt.ArrayLike | Tensor,
    sizes: Sequence[tuple[int, int]],
) -> Tensor:
    """Convert cameras to pose encodings float64 [S, 9], without their principal points.

    Args:
        viewmats: [S, 4, 4] or [S, 3, 4], world to camera.
        intrinsics: [S, 3, 3], pixels.
        sizes: height and width of each view, pixels.
    """
    w2c = _numpy(viewmats)[:, :3]
    rotation, K = w2c[:, :, :3].swapaxes(1, 2), _numpy(intrinsics)
    centers = -(rotation @ w2c[:, :, 3:])[..., 0]
    focals = np.stack([K[:, 1, 1], K[:, 0, 0]], axis=-1)
    quaternions = np.stack([_quaternion(one) for one in rotation])
    fields = 2.0 * np.arctan(np.array(sizes, dtype=np.float64) / 2.0 / focals)
    return torch.from_numpy(np.concatenate([centers, quaternions, fields], axis=1))


def normalized_viewmats(viewmats: npt.ArrayLike | Tensor) -> Float64:
    """Map world-to-camera [S, 4, 4] to the frame of the first and the unit of the training.

    The median distance of all centers from the first (the lower one of an even number) becomes 1,
    unless it was below 0.1.
    """
    world = _numpy(viewmats)
    relative: Float64 = world @ np.linalg.inv(world[0])
    centers = -(relative[:, :3, :3].swapaxes(1, 2) @ relative[:, :3, 3:])[..., 0]
    distances = np.sort(np.linalg.norm(centers - centers[0], axis=1))
    relative[:, :3, 3] /= max(MIN_UNIT, float(distances[(len(distances) - 1) // 2]))
    return relative


def cameras_of_rays(
    rays: npt.ArrayLike | Tensor,
    confidence: npt.ArrayLike | Tensor,
    height: int,
    width: int,
    samples: npt.ArrayLike | None = None,
    seed: int = 0,
    official: bool = False,
) -> tuple[Float64, Float64]:
    """Estimate the cameras that explain the rays of views best.

    The rays' directions are a homography of their positions in the image, which RANSAC finds and a
    fit to all inliers refines. Its lower triangular factor gives rotation and focal lengths.

    Args:
        rays: float [S, h, w, 6], direction and origin, evenly over the image.
        confidence: float [S, h, w], weights of rays, not negative.
        height, width: of the views, pixels.
        samples: int [samples, 8], ranks of rays in the order of their confidence; by default drawn
            from the most confident 30 %.
        seed: of the samples.
        official: compute as the published code, which takes the principal point from the lower
            triangular factor, and divides by a z near 0 for views across the reference.

    Returns:
        World to camera float64 [S, 3, 4], and intrinsics float64 [S, 3, 3] in pixels.

    Raises:
        IgsrError: no camera fits the rays of a view.
    """
    all_rays, weights = _numpy(rays), _numpy(confidence)
    rows, columns = weights.shape[1:]
    x = -1.0 + (2.0 * np.arange(columns) + 1.0) / columns
    y = -1.0 + (2.0 * np.arange(rows) + 1.0) / rows
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    candidates = max(SAMPLE_RAYS, int(SAMPLED_FRACTION * len(places)))
    if samples is None:
        drawn = np.random.default_rng(seed).random((SAMPLES, SAMPLE_RAYS))
        samples = (drawn * min(candidates, len(places))).astype(np.int64)
    ranks = np.asarray(samples, dtype=np.int64)
    rotations, centers, intrinsics = [], [], []
    for n, (view, weight) in enumerate(zip(all_rays, weights, strict=True)):
        flat, weight = view.reshape(-1, 6), weight.ravel()
        known = np.isfinite(flat).all(axis=1) & np.isfinite(weight)
        weight = np.where(known, weight, 0.0)
        directions, origins = (
            np.where(known[:, None], part, 1.0) for part in np.split(flat, 2, axis=1)
        )
        turn = np.eye(3) if official else _turn_ahead(directions, weight)
        directions = directions @ turn.T
        weight = np.where(np.abs(directions[:, 2]) > MIN_RAY_Z, weight, 0.0)
        directions[weight == 0.0] = 1.0
        targets = directions[:, :2] / directions[:, 2:]
        best = np.argsort(-weight, kind="stable")[:candidates]
        homography = _homography(places, targets, weight, best[ranks])
        if homography is None:
            raise IgsrError(f"the rays of view {n} fit no camera, so its prediction is useless")
        rotation, K = _decomposed(homography)
        rotations.append(turn.T @ rotation)
        centers.append(weight @ origins / weight.sum())
        half = np.array([width / 2.0, height / 2.0])
        center = (K[:2, 2] + 1.0) * half if official else half
        intrinsics.append(
            intrinsic_matrix(K[0, 0] * half[0], K[1, 1] * half[1], center[0], center[1])
        )
    return _w2c(np.stack(rotations), np.stack(centers)), np.stack(intrinsics)


def _turn_ahead(directions: Float64, weights: Float64) -> Float64:
    """The rotation [3, 3] of the mean of directions [N, 3] onto the z axis."""
    x, y, z = _unit(weights @ _unit(directions))
    # The reflection that swaps that direction with z, after one that leaves z unchanged.
    between = _unit(np.array([x, y, z + np.copysign(1.0, z)]))
    swap = 2.0 * np.outer(between, between) - np.eye(3)
    turn: Float64 = swap if z >= 0.0 else np.diag([1.0, -1.0, -1.0]) @ swap
    return turn


def _homography(
    places: Float64, targets: Float64, weights: Float64, samples: npt.NDArray[np.int64]
) -> Float64 | None:
    """The homography [3, 3] from places [N, 2] to targets [N, 2] with the most inlier weight."""
    # The rows [N, 2, 9] of the direct linear transform.
    whole = np.pad(places, ((0, 0), (0, 1)), constant_values=1.0)
    nothing = np.zeros_like(whole)
    u, v = targets[:, :1], targets[:, 1:]
    equations = np.stack(
        [
            np.concatenate([whole, nothing, -u * whole], axis=1),
            np.concatenate([nothing, whole, -v * whole], axis=1),
        ],
        axis=1,
    )

    def solved(used: npt.NDArray[np.int64]) -> Float64:
        rows = (equations[used] * np.sqrt(weights[used])[:, None, None]).reshape(-1, 9)
        # Faster than a singular value decomposition of all rows.
        solution = np.linalg.eigh(rows.T @ rows)[1][:, 0]
        homography: Float64 = (solution / solution[8]).reshape(3, 3)
        return homography

    inliers, best_score = None, 0.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for sample in samples:
            homography = solved(sample)
            mapped = places @ homography[:, :2].T + homography[:, 2]
            distance = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - targets, axis=1)
            near = (distance < MAX_INLIER_DISTANCE) & (weights > 0)
            score = float(weights[near].sum())
            if score > best_score:
                inliers, best_score = near, score
    if inliers is None:
        return None
    refined = solved(np.flatnonzero(inliers))
    determinant = np.linalg.det(refined)
    if not (np.isfinite(refined).all() and abs(determinant) > 0.0):
        return None
    return refined if determinant > 0.0 else -refined


def _decomposed(homography: Float64) -> tuple[Float64, Float64]:
    """Camera-to-world rotation [3, 3], and intrinsics [3, 3] on an image plane of 2 x 2."""
    # Reversing the columns before a QR makes the triangular factor a lower one.
    rotation, factor = np.linalg.qr(homography[:, ::-1])
    rotation, factor = rotation[:, ::-1], factor[::-1, ::-1]
    signs = np.where(np.diag(factor) < 0.0, -1.0, 1.0)
    lower = signs[:, None] * factor
    lower = lower / lower[2, 2]
    K = intrinsic_matrix(1.0 / lower[0, 0], 1.0 / lower[1, 1], lower[2, 0], lower[2, 1])
    return rotation * signs, K


def _w2c(rotations: Float64, centers: Float64) -> Float64:
    """World to camera [S, 3, 4] of camera-to-world rotations [S, 3, 3] and centers [S, 3]."""
    back = rotations.swapaxes(1, 2)
    return np.concatenate([back, -back @ centers[..., None]], axis=2)


def _quaternion(rotation: Float64) -> Float64:
    """(x, y, z, w), w not negative, of a rotation [3, 3]: the eigenvector of its Davenport form."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    form = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    quaternion: Float64 = np.linalg.eigh(form)[1][:, 3]
    return -quaternion if quaternion[3] < 0.0 else quaternion


def _unit(vectors: Float64) -> Float64:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Float64 = vectors / np.where(length > 0.0, length, 1.0)
    return unit


def _numpy(value: npt.ArrayLike | Tensor) -> Float64:
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    return np.asarray(value, dtype=np.float64)
