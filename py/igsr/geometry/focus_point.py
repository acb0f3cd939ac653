"""The focus point: where the optical axes of cameras meet."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera

Float64 = npt.NDArray[np.float64]


def focus_point(cameras: list[Camera]) -> Float64:
    """The point nearest to all optical axes, in the least-squares sense.

    A small pull towards a point in front of the cameras keeps parallel axes solvable.

    Args:
        cameras: at least one.

    Returns:
        float64 [3], world frame.
    """
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.viewmat[2, :3] for camera in cameras])
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) or 1.0
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    in_front = (centers + spread * axes).mean(axis=0)
    pull = 1e-3
    matrix = across.mean(axis=0) + pull * np.eye(3)
    right = np.einsum("nij,nj->i", across, centers) / len(cameras) + pull * in_front
    point: Float64 = np.linalg.solve(matrix, right)
    # Axes that part ways meet behind the cameras; the scene is still in front of them.
    if np.mean((point - centers) @ axes.mean(axis=0)) <= 0:
        point = in_front
    return point
