"""Points on the rays of photo pixels, at the depth where other photos have the most alike color.

For photos that look from far apart: single pixels are compared, of softened photos, where
``plane_sweep`` compares patches.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.fitting.initialization.camera_coverage import pixels_of
from igsr.geometry.focus_point import focus_point

Float64 = npt.NDArray[np.float64]

#: Depths tried per ray, and their range in units of the distance to what the cameras look at.
RAY_DEPTHS = 32
NEAREST_DEPTH, FARTHEST_DEPTH = 0.25, 8.0
#: Photos compared with per ray: more cost time and see other sides of the scene.
COMPARED_VIEWS = 24


def ray_points(
    views: list[View], count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Points on the rays of random pixels, at the depth where other photos agree best.

    Args:
        views: the photos; masked pixels have no rays and are not compared.
        count: number of points.
        random: what draws the rays.

    Returns:
        Points [count, 3] in the world frame and colors [count, 3] in 0..1.
    """
    target = focus_point([view.camera for view in views])
    depths = np.geomspace(NEAREST_DEPTH, FARTHEST_DEPTH, RAY_DEPTHS)
    compared = [_softened(view) for view in views]
    centres = np.stack([view.camera.center for view in views])
    per_view = np.bincount(random.integers(len(views), size=count), minlength=len(views))
    points, colors = [], []
    for v, (view, rays) in enumerate(zip(views, per_view, strict=True)):
        usable = np.arange(view.camera.width * view.camera.height)
        if view.mask is not None:
            usable = np.flatnonzero(view.mask)
        pixel = random.choice(usable, size=rays)
        camera = view.camera
        columns, rows = pixel % camera.width + 0.5, pixel // camera.width + 0.5
        directions = np.stack(
            [
                (columns - camera.K[0, 2]) / camera.K[0, 0],
                (rows - camera.K[1, 2]) / camera.K[1, 1],
                np.ones(rays),
            ],
            axis=1,
        )
        reach = float(np.linalg.norm(target - camera.center))
        # Jitter each ray's depths, or all points would lie on a few shells.
        jitter = np.exp(random.uniform(-0.5, 0.5, size=rays) * np.log(depths[1] / depths[0]))
        z = reach * depths[None, :] * jitter[:, None]
        local = directions[:, None, :] * z[..., None] - camera.viewmat[:3, 3]
        world = (local @ camera.viewmat[:3, :3]).reshape(-1, 3)
        own = compared[v][pixel]
        near = np.argsort(np.linalg.norm(centres - centres[v], axis=1), kind="stable")
        errors = []
        for other in near[1 : COMPARED_VIEWS + 1]:
            index, inside = pixels_of(views[other], world)
            difference = np.abs(
                compared[other][index].reshape(rays, RAY_DEPTHS, 3) - own[:, None, :]
            ).mean(axis=2)
            errors.append(np.where(inside.reshape(rays, RAY_DEPTHS), difference, np.nan))
        best = (
            _most_agreed(np.stack(errors), random)
            if errors
            else random.integers(RAY_DEPTHS, size=rays)
        )
        points.append(world.reshape(rays, RAY_DEPTHS, 3)[np.arange(rays), best])
        colors.append(view.image.reshape(-1, view.image.shape[2])[pixel, :3] / 255.0)
    return np.concatenate(points), np.concatenate(colors)


def _most_agreed(errors: Float64, random: np.random.Generator) -> npt.NDArray[np.int64]:
    """For each ray the index of the depth whose median error over the views is lowest.

    Args:
        errors: [V, R, D], NaN where a view does not see the point.
        random: decides between equals.
    """
    seen = np.isfinite(errors).sum(axis=0)
    ordered = np.sort(np.where(np.isfinite(errors), errors, np.inf), axis=0)
    # The lower median over those that see it: the rest may be hidden behind something.
    middle = np.maximum(seen - 1, 0) // 2
    cost = np.take_along_axis(ordered, middle[None], axis=0)[0]
    # What a single view sees agrees with it by chance, at any depth.
    cost = np.where(seen >= min(3, len(errors)), cost, 2.0)
    # Ties (flat colour, nothing seen) must not all fall to the nearest depth.
    cost = cost + 1e-3 * random.uniform(size=cost.shape)
    return np.asarray(cost.argmin(axis=1))


def _softened(view: View) -> npt.NDArray[np.float32]:
    """The photo's colors [H * W, 3] in 0..1, blurred by 5 x 5 pixels: poses are not that exact."""
    image = view.image[..., :3].astype(np.float32) / 255.0
    for axis in (0, 1):
        padded = np.concatenate(
            [np.take(image, [0, 0], axis=axis), image, np.take(image, [-1, -1], axis=axis)],
            axis=axis,
        )
        length = image.shape[axis]
        image = np.mean(
            [np.take(padded, range(i, i + length), axis=axis) for i in range(5)], axis=0
        )
    return image.reshape(-1, 3)
