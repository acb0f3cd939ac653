"""What is known of a photo after the alignment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.geometry.similarity import Similarity
from igsr.pose.grid import Grid

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

    def shown_at(self, xyz: Float64) -> tuple[npt.NDArray[np.bool_], Float64, Float32, Float32]:
        """Where the photo shows world points [M, 3].

        Returns:
            Which points are before the camera and in the grid, bool [M]; their z-depths [M]; depth
            and confidence [M] of the pixels that show them, of any pixel for the others.
        """
        local = xyz @ self.camera.viewmat[:3, :3].T + self.camera.viewmat[:3, 3]
        z, K, grid = local[:, 2], self.camera.K, self.grid
        shown = z > 0.0
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            pixels = local[:, :2] / z[:, None] * K[[0, 1], [0, 1]] + K[[0, 1], 2]
            cells = (pixels - [grid.offset_x, grid.offset_y]) / [grid.scale_x, grid.scale_y]
            shown &= ((cells >= 0.0) & (cells < [grid.width, grid.height])).all(axis=1)
        column, row = np.where(shown[:, None], cells, 0.0).astype(np.int64).T
        return shown, z, self.depth[row, column], self.confidence[row, column]

    def depths_at(self, pixels: Float64) -> Float64:
        """Depths [M] at pixels [M, 2] of the photo, NaN where they are not known."""
        grid = self.grid
        cells = (pixels - [grid.offset_x, grid.offset_y]) / [grid.scale_x, grid.scale_y]
        inside = np.all((cells >= 0.0) & (cells < [grid.width, grid.height]), axis=1)
        column, row = np.where(inside[:, None], cells, 0.0).astype(np.int64).T
        depth = np.where(inside, self.depth[row, column], np.nan).astype(np.float64)
        return np.where(depth > 0.0, depth, np.nan)

    def mapped(self, similarity: Similarity) -> AlignedPhoto:
        """The photo in another world.

        Args:
            similarity: to the other world.
        """
        depth = (self.depth * np.float64(similarity.scale)).astype(np.float32)
        return replace(self, camera=similarity.camera(self.camera), depth=depth)
