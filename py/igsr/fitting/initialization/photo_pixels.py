"""Pixels of photos: which of them count, their rays, and where world points project to."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, View
from igsr.capture.downscaling import reduced_size, reduced_view

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]


def reduced(view: View, max_side_px: int) -> View:
    """The view, reduced to at most ``max_side_px`` on its longer side."""
    camera = view.camera
    return reduced_view(view, *reduced_size(camera.width, camera.height, max_side_px))


def usable_pixels(view: View) -> Bool:
    """Pixels [H, W] that are not masked and fully opaque."""
    usable = np.ones(view.image.shape[:2], dtype=np.bool_) if view.mask is None else view.mask
    return usable & (view.image[..., 3] == 255) if view.image.shape[2] == 4 else usable


def pixels_with_depth(view: View) -> Bool:
    """Usable pixels [H, W] with a depth; the view must have a depth map."""
    assert view.depth is not None
    known: Bool = usable_pixels(view) & (view.depth > 0.0)
    if view.depth_confidence is not None:
        known &= view.depth_confidence > 0.0
    return known


def project(camera: Camera, world: Float64) -> tuple[Int64, Int64, Float64, Bool]:
    """Row, column and z-depth [P] of world points [P, 3], and whether they are in the image.

    Row and column are 0 for points outside the image.
    """
    local = world @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    x = camera.K[0, 0] * local[:, 0] / depth + camera.K[0, 2]
    y = camera.K[1, 1] * local[:, 1] / depth + camera.K[1, 2]
    inside = (local[:, 2] > 1e-9) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    row, column = np.where(inside, y, 0.0), np.where(inside, x, 0.0)
    return row.astype(np.int64), column.astype(np.int64), depth, inside


def project_to_photo(view: View, world: Float64) -> tuple[Int64, Bool]:
    """Flat pixel index [P] of world points [P, 3], and whether an unmasked pixel shows them."""
    row, column, _, inside = project(view.camera, world)
    index = row * view.camera.width + column
    if view.mask is not None:
        inside &= view.mask.reshape(-1)[index]
    return index, inside


def pixel_rays(camera: Camera, columns: Int64, rows: Int64) -> Float64:
    """Points [P, 3] at z = 1 on the rays through pixel centers, in the frame of the camera."""
    return np.stack(
        [
            (columns + 0.5 - camera.K[0, 2]) / camera.K[0, 0],
            (rows + 0.5 - camera.K[1, 2]) / camera.K[1, 1],
            np.ones(len(columns)),
        ],
        axis=1,
    )


def to_world(camera: Camera, local: Float64) -> Float64:
    """World points of points in the frame of the camera, [..., 3]."""
    world: Float64 = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return world


def world_points(view: View, rows: Int64, columns: Int64) -> Float64:
    """World points [P, 3] of pixels with depth."""
    assert view.depth is not None
    depth = view.depth[rows, columns].astype(np.float64)
    return to_world(view.camera, pixel_rays(view.camera, columns, rows) * depth[:, None])


def camera_centers(views: list[View]) -> Float64:
    """Positions [V, 3] of the views' cameras, world frame."""
    return np.array([view.camera.centre for view in views]).reshape(-1, 3)


def by_distance(centers: Float64, k: int) -> list[int]:
    """Indices of the other centers [V, 3], by distance to center ``k``."""
    order = np.argsort(np.linalg.norm(centers - centers[k], axis=1), kind="stable")
    return [int(i) for i in order if i != k]


def at_most(
    limit: int, points: tuple[Float64, ...], random: np.random.Generator
) -> tuple[Float64, ...]:
    """``limit`` random rows of each array, in their order, or all if there are no more."""
    count = len(points[0])
    if count <= limit:
        return points
    chosen = np.sort(random.choice(count, size=limit, replace=False))
    return tuple(array[chosen] for array in points)
