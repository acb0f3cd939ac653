"""What is known of a photo after the alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.pose.alignment.predictions import Grid

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AlignedPhoto:
    """A registered photo.

    Attributes:
        camera: in pixels of the photo.
        grid: where depth and confidence lie in the photo.
        depth: float32 [h, w], z-depth in world units, NaN where unknown.
        confidence: float32 [h, w], the greatest raw confidence of all its edges; 1 where there is
            none.
    """

    camera: Camera
    grid: Grid
    depth: Float32
    confidence: Float32

    def world_points(self) -> tuple[Float64, npt.NDArray[np.int64]]:
        """World points [M, 3] of the pixels whose depth is known, and their flat indices [M]."""
        index = np.flatnonzero(np.isfinite(self.depth))
        K, viewmat = self.camera.K, self.camera.viewmat
        slopes = (self.grid.photo_pixels()[index] - K[[0, 1], 2]) / K[[0, 1], [0, 1]]
        rays = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0)
        local = rays * self.depth.ravel()[index, None]
        return (local - viewmat[:3, 3]) @ viewmat[:3, :3], index
