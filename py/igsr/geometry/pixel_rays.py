"""The directions that a camera's pixels look in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera


def pixel_rays(camera: Camera) -> npt.NDArray[np.float32]:
    """Directions [H * W, 3] of a camera's pixels, row by row, with z of 1, in its axes.

    Args:
        camera: pinhole, OpenCV axes, pixel centers at +0.5.
    """
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
    K = camera.K
    x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)
