"""What cameras see of the world: the box that they look at, and the pixels of world points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, View
from igsr.geometry.focus_point import focus_point

Float64 = npt.NDArray[np.float64]


def looked_at_box(cameras: list[Camera]) -> tuple[Float64, Float64]:
    """Lowest and highest corner [3], in the world frame, of the cube that the cameras look at.

    It lies around their focus point and is as large as what their photos show at that distance.
    """
    target = focus_point(cameras)
    distances = [float(np.linalg.norm(camera.center - target)) for camera in cameras]
    tangents = [0.5 * max(c.width / c.K[0, 0], c.height / c.K[1, 1]) for c in cameras]
    half_side = float(np.median(distances) * np.median(tangents))
    return target - half_side, target + half_side


def pixels_of(view: View, xyz: Float64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """The pixel that each world point falls on in a view.

    Args:
        view: the photo with its camera.
        xyz: [P, 3] in the world frame.

    Returns:
        Index [P] of the pixel, row by row, and whether [P] the point is in front of the camera,
        within the photo and not masked; the index is 0 where it is not.
    """
    camera = view.camera
    local = xyz @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = np.maximum(local[:, 2], 1e-9)
    x = np.floor(camera.K[0, 0] * local[:, 0] / z + camera.K[0, 2])
    y = np.floor(camera.K[1, 1] * local[:, 1] / z + camera.K[1, 2])
    inside = (local[:, 2] > 1e-9) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    index = np.where(inside, y * camera.width + x, 0).astype(np.int64)
    if view.mask is not None:
        inside &= view.mask.reshape(-1)[index]
    return index, inside
