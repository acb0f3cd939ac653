"""Which pixels of a photo count, which points they show, and which of them show a point."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.capture.downscaling import reduced_size, reduced_view

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

#: Pixels of the longer side at which depths are compared; bounds time and memory.
LONGEST = 512


def usable_pixels(view: View) -> Bool:
    """Which pixels [H, W] are neither masked nor transparent in part."""
    usable = np.ones(view.image.shape[:2], dtype=np.bool_) if view.mask is None else view.mask
    return usable & (view.image[..., 3] == 255) if view.image.shape[2] == 4 else usable


def pixels_of(view: View, world: Float64) -> tuple[Int64, Int64, Float64, Bool]:
    """Row, column and z-depth [P] of world points [P, 3], and which fall into the photo."""
    camera = view.camera
    local = world @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    x = camera.K[0, 0] * local[:, 0] / depth + camera.K[0, 2]
    y = camera.K[1, 1] * local[:, 1] / depth + camera.K[1, 2]
    inside = (local[:, 2] > 1e-9) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    row, column = np.where(inside, y, 0.0), np.where(inside, x, 0.0)
    return row.astype(np.int64), column.astype(np.int64), depth, inside


def reduced(view: View) -> View:
    """The view at the size at which depths are compared."""
    camera = view.camera
    return reduced_view(view, *reduced_size(camera.width, camera.height, LONGEST))


def known_pixels(view: View) -> Bool:
    """Which pixels [H, W] have a depth and are neither masked nor transparent in part."""
    assert view.depth is not None  # callers leave out views without
    known: Bool = usable_pixels(view) & (view.depth > 0.0)
    if view.depth_confidence is not None:
        known &= view.depth_confidence > 0.0
    return known


def world_points(view: View, rows: Int64, columns: Int64) -> Float64:
    """The world points [P, 3] of pixels."""
    assert view.depth is not None
    camera, depth = view.camera, view.depth[rows, columns].astype(np.float64)
    local = np.stack(
        [
            (columns + 0.5 - camera.K[0, 2]) / camera.K[0, 0] * depth,
            (rows + 0.5 - camera.K[1, 2]) / camera.K[1, 1] * depth,
            depth,
        ],
        axis=1,
    )
    world: Float64 = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return world
