"""Points from depth maps of a sensor or a network."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.fitting.initialization.photo_pixels import (
    at_most,
    by_distance,
    camera_centers,
    pixels_with_depth,
    project,
    reduced,
    world_points,
)

Float64 = npt.NDArray[np.float64]

#: Minimum fraction of photos with depth maps to start from these.
MIN_DEPTH_FRACTION = 0.5
#: Longer side at which depth maps are compared, pixels.
MAX_SIDE_PX = 512
#: A photo's surface is behind a point if it is further away by this fraction.
DEPTH_TOLERANCE = 0.1
#: Number of nearest photos to compare with.
COMPARED_PHOTOS = 8


def have_depths(views: list[View]) -> bool:
    """Whether enough photos have depth maps to start from."""
    with_depth = sum(view.depth is not None for view in views)
    return bool(views) and with_depth >= MIN_DEPTH_FRACTION * len(views)


def given_points(
    views: list[View], count: int, random: np.random.Generator
) -> tuple[Float64, Float64, Float64 | None]:
    """Return points of depth maps, without those that most other photos see through.

    Args:
        views: the photos; only unmasked, opaque pixels with depth give points.
        count: maximum number of points.
        random: chooses pixels; each photo gives the same number.

    Returns:
        Points [P, 3] in the world frame, their colors [P, 3] in 0..1, and the confidence [P] of
        their depths, or None if no photo has a confidence map.
    """
    small = [reduced(view, MAX_SIDE_PX) for view in views if view.depth is not None]
    centers = camera_centers(small)
    points, colors, confidences = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for k, view in enumerate(small):
        rows, columns = np.nonzero(pixels_with_depth(view))
        # Twice the share of a photo, because some points are removed.
        share = min(len(rows), 2 * count // len(small) + 1)
        chosen = np.sort(random.choice(len(rows), size=share, replace=False))
        rows, columns = rows[chosen], columns[chosen]
        world = world_points(view, rows, columns)
        others = [small[i] for i in by_distance(centers, k)[:COMPARED_PHOTOS]]
        kept = ~_seen_through(world, others)
        rows, columns = rows[kept], columns[kept]
        points.append(world[kept])
        colors.append(view.image[rows, columns, :3] / 255.0)
        confidence = view.depth_confidence
        confidences.append(np.ones(len(rows)) if confidence is None else confidence[rows, columns])
    arrays = (np.concatenate(points), np.concatenate(colors), np.concatenate(confidences))
    xyz, rgb, confidence = at_most(count, arrays, random)
    has_confidence = any(view.depth_confidence is not None for view in small)
    return xyz, rgb, confidence if has_confidence else None


def _seen_through(world: Float64, views: list[View]) -> npt.NDArray[np.bool_]:
    """Points [P, 3] in front of the surface of more views than show them on their surface."""
    in_front, on_surface = np.zeros(len(world), np.int64), np.zeros(len(world), np.int64)
    for view in views:
        row, column, depth, inside = project(view.camera, world)
        assert view.depth is not None
        inside &= pixels_with_depth(view)[row, column]
        surface = view.depth[row, column]
        in_front += inside & (depth < (1.0 - DEPTH_TOLERANCE) * surface)
        on_surface += inside & (np.abs(depth - surface) <= DEPTH_TOLERANCE * surface)
    return in_front > on_surface
