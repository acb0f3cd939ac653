"""Depth maps that came with photos: scaled to the unit of the cameras, and checked.

A depth camera measures meters, a network guesses, and cameras found from photos have an arbitrary
unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr._internal.user_warning import warn_user
from igsr.capture import Points, View
from igsr.fitting.initialization.given_depths import COMPARED_PHOTOS, MAX_SIDE_PX
from igsr.fitting.initialization.photo_pixels import (
    by_distance,
    camera_centers,
    pixels_with_depth,
    project,
    reduced,
    world_points,
)

Float64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

#: Minimum number of points with depth to scale a depth map.
MIN_POINTS = 20
#: Maximum median deviation of the log ratios of depths from their median; more is no depth map of
#: this photo.
MAX_DEVIATION = 0.25
#: Number of points per photo for comparing two photos, and the minimum in the other photo.
COMPARED_POINTS = 2000
MIN_COMPARED_POINTS = 100
#: Two photos agree if the median log ratio of their depths is below this.
MAX_LOG_RATIO = 0.1
#: Photos from opposite sides see different surfaces: both ratios are positive. That is assumed if
#: their mean is above this fraction of half their difference.
OPPOSITE_SIDES = 0.5


def with_scaled_depths(views: Sequence[View], points: Points | None) -> list[View]:
    """Scale each depth map by the median ratio of the depths of its points (tracks) to its own.

    Args:
        views: with or without depth maps.
        points: of the capture; without tracks, depth maps stay as they are.

    Returns:
        The views in their order. Depth maps that do not fit their points are removed.

    Raises:
        UserWarning: naming the photos whose depth maps are removed.
    """
    if points is None or points.tracks is None:
        return list(views)
    tracks = points.tracks
    index_of = {name: index for index, name in enumerate(tracks.names)}
    scaled, removed = [], []
    for view in views:
        index = index_of.get(view.name)
        if view.known_depth is None or index is None:
            scaled.append(view)
            continue
        of_view = tracks.view == index
        ratios = _log_ratios(view, points.xyz[tracks.point[of_view]], tracks.xy[of_view])
        if len(ratios) < MIN_POINTS:
            scaled.append(view)
            continue
        median = np.median(ratios)
        if np.median(np.abs(ratios - median)) > MAX_DEVIATION:
            removed.append(view.name)
            scaled.append(replace(view, depth=None, depth_confidence=None))
            continue
        assert view.depth is not None
        depth = (view.depth * np.exp(median)).astype(np.float32)
        scaled.append(replace(view, depth=depth))
    if removed:
        warn_user(
            f"The depth of {', '.join(removed)} does not fit the points of the capture and is "
            "not used."
        )
    return scaled


def _log_ratios(view: View, xyz: Float64, xy: Float64) -> Float64:
    """Logs of the points' depths over the photo's depth at their pixels, where it has one."""
    camera, depth = view.camera, view.known_depth
    assert depth is not None
    z = xyz @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    column, row = np.floor(xy).astype(np.int64).T
    inside = (z > 0.0) & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    column, row, z = column[inside], row[inside], z[inside]
    own = depth[row, column].astype(np.float64)
    ratios: Float64 = np.log(z[own > 0.0]) - np.log(own[own > 0.0])
    return ratios


def with_consistent_depths(views: Sequence[View]) -> list[View]:
    """Remove depth maps that contradict other photos.

    Photos are compared in pairs. Of the groups of photos that agree, the largest is taken to be
    right; depth maps that contradict one of its photos are removed. If no group is larger than the
    others, all stay.

    Args:
        views: with or without depth maps, in the unit of their cameras.

    Returns:
        The views in their order.

    Raises:
        UserWarning: naming the photos whose depth maps are removed.
    """
    with_depths = [k for k, view in enumerate(views) if view.known_depth is not None]
    agree, contradict = _compare([reduced(views[k], MAX_SIDE_PX) for k in with_depths])
    group = _groups(agree)
    sizes = np.bincount(group, minlength=1)
    largest = int(np.argmax(sizes))
    if sizes[largest] < 2 or np.count_nonzero(sizes == sizes[largest]) > 1:
        return list(views)
    right = group == largest
    wrong = ~right & contradict[:, right].any(axis=1)
    removed = {with_depths[int(i)] for i in np.nonzero(wrong)[0]}
    if removed:
        names = ", ".join(views[k].name for k in sorted(removed))
        warn_user(f"The depth of {names} contradicts the other photos and is not used.")
    return [
        replace(view, depth=None, depth_confidence=None) if k in removed else view
        for k, view in enumerate(views)
    ]


def _compare(views: list[View]) -> tuple[Bool, Bool]:
    """Pairs of photos [N, N] whose depth maps agree, and pairs that contradict each other."""
    count = len(views)
    agree, contradict = (np.zeros((count, count), dtype=np.bool_) for _ in range(2))
    points = [_some_points(view) for view in views]
    centers = camera_centers(views)
    for i in range(count):
        for j in by_distance(centers, i)[:COMPARED_PHOTOS]:
            ratio_i = _median_log_ratio(points[i], views[j])
            ratio_j = _median_log_ratio(points[j], views[i])
            if ratio_i is None or ratio_j is None:
                continue
            half_difference, mean = abs(ratio_i - ratio_j) / 2.0, abs(ratio_i + ratio_j) / 2.0
            if mean <= max(MAX_LOG_RATIO, OPPOSITE_SIDES * half_difference):
                pairs = agree if half_difference <= MAX_LOG_RATIO else contradict
                pairs[i, j] = pairs[j, i] = True
    return agree, contradict


def _groups(agree: Bool) -> npt.NDArray[np.int64]:
    """Number [N] of each photo's group; photos that agree are in one group."""
    group = np.arange(len(agree))
    for i, j in np.argwhere(agree):
        group[group == group[j]] = group[i]
    return group


def _some_points(view: View) -> Float64:
    """At most ``COMPARED_POINTS`` world points [P, 3] of a depth map, evenly spaced."""
    rows, columns = np.nonzero(pixels_with_depth(view))
    chosen = np.linspace(0, len(rows) - 1, min(COMPARED_POINTS, len(rows))).astype(np.int64)
    return world_points(view, rows[chosen], columns[chosen])


def _median_log_ratio(world: Float64, view: View) -> float | None:
    """Median log ratio of the depths of points to the photo's; None if it shows too few."""
    row, column, depth, inside = project(view.camera, world)
    inside &= pixels_with_depth(view)[row, column]
    if np.count_nonzero(inside) < MIN_COMPARED_POINTS:
        return None
    assert view.depth is not None
    return float(np.median(np.log(depth[inside]) - np.log(view.depth[row, column][inside])))
