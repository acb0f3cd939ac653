"""Pose encodings of Depth Anything 3 (arXiv 2511.10647, section 3).

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

Float64 = npt.NDArray[np.float64]

#: Minimum tangent of half a field of view.
MIN_TANGENT = 1e-6
#: Minimum unit of known cameras.
MIN_UNIT = 0.1


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
