"""Depths that photos came with, in the unit of the cameras.

A depth camera measures metres, a network guesses, and cameras from photos have a unit of their own.
Points of the capture that a photo is known to show tell what its depths are to be multiplied by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from igsr._internal.user_warning import warn_user
from igsr.capture import Points, View

#: With fewer points on known depths, a photo's depths stay as they are.
FEWEST = 20
#: Median difference of the ratios' logarithms from their median, above which depths are of
#: something else.
MOST_SPREAD = 0.25


def with_scaled_depths(views: Sequence[View], points: Points | None) -> list[View]:
    """Views whose depths have the unit of their cameras, photo by photo.

    Each photo's depths are multiplied by the median, over the points that it is known to show
    (tracks), of the point's depth over the photo's depth there.

    Args:
        views: with or without depths.
        points: of the capture; without tracks the depths stay as they are.

    Returns:
        The views in their order. Depths that do not fit to their points are left out.

    Raises:
        UserWarning: naming the photos whose depths are left out.
    """
    if points is None or points.tracks is None:
        return list(views)
    tracks = points.tracks
    number = {name: index for index, name in enumerate(tracks.names)}
    scaled, left_out = [], []
    for view in views:
        index = number.get(view.name)
        if view.known_depth is None or index is None:
            scaled.append(view)
            continue
        of_view = tracks.view == index
        ratios = _ratios(view, points.xyz[tracks.point[of_view]], tracks.xy[of_view])
        if len(ratios) < FEWEST:
            scaled.append(view)
            continue
        middle = np.median(ratios)
        if np.median(np.abs(ratios - middle)) > MOST_SPREAD:
            left_out.append(view.name)
            scaled.append(replace(view, depth=None, depth_confidence=None))
            continue
        assert view.depth is not None
        depth = (view.depth * np.exp(middle)).astype(np.float32)
        scaled.append(replace(view, depth=depth))
    if left_out:
        warn_user(
            f"The depth of {', '.join(left_out)} does not fit to the points of the capture and is "
            "left out."
        )
    return scaled


def _ratios(view: View, xyz: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """The logarithms of points' depths over the photo's, where the photo has one."""
    camera, depth = view.camera, view.known_depth
    assert depth is not None
    z = xyz @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    column, row = np.floor(xy).astype(np.int64).T
    inside = (z > 0.0) & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    column, row, z = column[inside], row[inside], z[inside]
    there = depth[row, column].astype(np.float64)
    return np.log(z[there > 0.0]) - np.log(there[there > 0.0])
