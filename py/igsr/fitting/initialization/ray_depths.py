"""Points on rays of photo pixels, at the depth where other photos have the most similar color.

For photos from far apart: single pixels of blurred photos are compared, not patches.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.fitting.initialization.photo_pixels import (
    by_distance,
    camera_centers,
    pixel_rays,
    project_to_photo,
    to_world,
)
from igsr.geometry.focus_point import focus_point

Float64 = npt.NDArray[np.float64]

#: Depths tried per ray, and their range in units of the distance to the cameras' focus point.
RAY_DEPTHS = 32
MIN_DEPTH = 0.25
MAX_DEPTH = 8.0
#: Number of nearest photos to compare with: more cost time and show other sides.
COMPARED_PHOTOS = 24


def ray_points(
    views: list[View], count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Return points on rays of random pixels.

    Args:
        views: the photos; masked pixels are not used.
        count: number of points.
        random: draws the rays.

    Returns:
        Points [count, 3] in the world frame and their colors [count, 3] in 0..1.
    """
    target = focus_point([view.camera for view in views])
    centers = camera_centers(views)
    depths = np.geomspace(MIN_DEPTH, MAX_DEPTH, RAY_DEPTHS)
    blurred = [_blurred(view) for view in views]
    per_view = np.bincount(random.integers(len(views), size=count), minlength=len(views))
    points, colors = [], []
    for v, (view, rays) in enumerate(zip(views, per_view, strict=True)):
        camera = view.camera
        usable = np.arange(camera.width * camera.height)
        if view.mask is not None:
            usable = np.flatnonzero(view.mask)
        pixel = random.choice(usable, size=rays)
        directions = pixel_rays(camera, pixel % camera.width, pixel // camera.width)
        distance = float(np.linalg.norm(target - camera.centre))
        # Without jitter, all points would be on a few shells.
        jitter = np.exp(random.uniform(-0.5, 0.5, size=rays) * np.log(depths[1] / depths[0]))
        z = distance * depths[None, :] * jitter[:, None]
        world = to_world(camera, directions[:, None, :] * z[..., None]).reshape(-1, 3)
        color = blurred[v][pixel]
        errors = []
        for other in by_distance(centers, v)[:COMPARED_PHOTOS]:
            index, visible = project_to_photo(views[other], world)
            other_color = blurred[other][index].reshape(rays, RAY_DEPTHS, 3)
            difference = np.abs(other_color - color[:, None, :]).mean(axis=2)
            errors.append(np.where(visible.reshape(rays, RAY_DEPTHS), difference, np.nan))
        if errors:
            best = _best_depths(np.stack(errors), random)
        else:
            best = random.integers(RAY_DEPTHS, size=rays)
        points.append(world.reshape(rays, RAY_DEPTHS, 3)[np.arange(rays), best])
        colors.append(view.image.reshape(-1, view.image.shape[2])[pixel, :3] / 255.0)
    return np.concatenate(points), np.concatenate(colors)


def _best_depths(errors: Float64, random: np.random.Generator) -> npt.NDArray[np.int64]:
    """Index of the depth of each ray with the lowest median error over the photos.

    Args:
        errors: [V, R, D], NaN where a photo does not show the point.
        random: breaks ties, which would otherwise all choose the nearest depth.
    """
    seen = np.isfinite(errors).sum(axis=0)
    ordered = np.sort(np.where(np.isfinite(errors), errors, np.inf), axis=0)
    # The lower median: the point may be occluded in the other photos.
    middle = np.maximum(seen - 1, 0) // 2
    cost = np.take_along_axis(ordered, middle[None], axis=0)[0]
    # One or two photos agree by chance, at any depth.
    cost = np.where(seen >= min(3, len(errors)), cost, 2.0)
    cost = cost + 1e-3 * random.uniform(size=cost.shape)
    return np.asarray(cost.argmin(axis=1))


def _blurred(view: View) -> npt.NDArray[np.float32]:
    """Colors [H * W, 3] in 0..1, averaged over 5 x 5 pixels because poses are not exact."""
    image = view.image[..., :3].astype(np.float32) / 255.0
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (2, 2)
        padded = np.pad(image, padding, mode="edge")
        length = image.shape[axis]
        image = np.mean(
            [np.take(padded, range(i, i + length), axis=axis) for i in range(5)], axis=0
        )
    return image.reshape(-1, 3)
