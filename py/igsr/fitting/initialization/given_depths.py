"""Points from the depths that photos came with, of a sensor or a network."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.fitting.initialization.photo_pixels import known_pixels, pixels_of, reduced, world_points

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

#: Part of the photos that must have depths for a fit to start from these.
PART = 0.5
#: Photos that look past a point see it stand before their surface by this part of its depth.
BEFORE = 0.1
#: Photos compared with, the nearest.
COMPARED = 8


def have_depths(views: list[View]) -> bool:
    """Whether enough of the photos have depths to start from."""
    return bool(views) and sum(view.depth is not None for view in views) >= PART * len(views)


def given_points(
    views: list[View], count: int, random: np.random.Generator
) -> tuple[Float64, Float64, Float64 | None]:
    """Points of photos' depths that not more photos look past than see.

    A wrong depth map shows things where other photos see through.

    Args:
        views: the photos; masked and transparent pixels and those without depth have no points.
        count: number of points, at most.
        random: what chooses among them; each photo has its share.

    Returns:
        Points [P, 3] in the world frame, their photos' colors [P, 3] in 0..1, and the depths'
        confidence [P], or None where no photo has one.
    """
    small = [reduced(view) for view in views if view.depth is not None]
    points, colors, confidences = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for k, view in enumerate(small):
        rows, columns = np.nonzero(known_pixels(view))
        # More than the photo's share, since some are left out.
        share = min(len(rows), 2 * count // len(small) + 1)
        chosen = np.sort(random.choice(len(rows), size=share, replace=False))
        rows, columns = rows[chosen], columns[chosen]
        world = world_points(view, rows, columns)
        stays = ~_looked_past(world, _nearest(k, small))
        rows, columns = rows[stays], columns[stays]
        points.append(world[stays])
        colors.append(view.image[rows, columns, :3] / 255.0)
        given = view.depth_confidence
        confidences.append(np.ones(len(rows)) if given is None else given[rows, columns])
    xyz, rgb, confidence = (np.concatenate(one) for one in (points, colors, confidences))
    if len(xyz) > count:
        chosen = np.sort(random.choice(len(xyz), size=count, replace=False))
        xyz, rgb, confidence = xyz[chosen], rgb[chosen], confidence[chosen]
    rated = any(view.depth_confidence is not None for view in small)
    return xyz, rgb, confidence if rated else None


def _nearest(k: int, views: list[View]) -> list[View]:
    centres = np.stack([view.camera.center for view in views])
    order = np.argsort(np.linalg.norm(centres - centres[k], axis=1), kind="stable")
    return [views[int(i)] for i in order if i != k][:COMPARED]


def _looked_past(world: Float64, others: list[View]) -> Bool:
    """Which points [P, 3] more of the other photos look past than see on their surface."""
    past, seen = np.zeros(len(world), np.int64), np.zeros(len(world), np.int64)
    for view in others:
        row, column, depth, inside = pixels_of(view, world)
        assert view.depth is not None
        inside &= known_pixels(view)[row, column]
        surface = view.depth[row, column]
        past += inside & (depth < (1.0 - BEFORE) * surface)
        seen += inside & (np.abs(depth - surface) <= BEFORE * surface)
    return past > seen
