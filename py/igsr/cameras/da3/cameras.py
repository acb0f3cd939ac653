"""Pose encodings of Depth Anything 3 (arXiv 2511.10647, section 3).

A pose encoding is (t, q, fov_h, fov_w): the camera's center in the world, its camera-to-world
rotation as a quaternion (x, y, z, w) of any length, and the vertical and horizontal field of view
in radians. The principal point is the center of the image. Axes are OpenCV's; pixels have their
centers at +0.5.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from torch import Tensor

from igsr._internal.rotations import rotations_of
from igsr.capture.types import intrinsic_matrix

Float64 = npt.NDArray[np.float64]

#: Minimum tangent of half a field of view.
MIN_TANGENT = 1e-6


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


def _w2c(rotations: Float64, centers: Float64) -> Float64:
    """World to camera [S, 3, 4] of camera-to-world rotations [S, 3, 3] and centers [S, 3]."""
    back = rotations.swapaxes(1, 2)
    return np.concatenate([back, -back @ centers[..., None]], axis=2)


def _unit(vectors: Float64) -> Float64:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Float64 = vectors / np.where(length > 0.0, length, 1.0)
    return unit


def _numpy(value: npt.ArrayLike | Tensor) -> Float64:
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    return np.asarray(value, dtype=np.float64)
