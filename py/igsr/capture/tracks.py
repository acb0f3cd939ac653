"""Confidence of points from their tracks, and tracks in undistorted and reduced photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from igsr.capture.types import Camera, Points, Tracks
from igsr.capture.undistort import Lens


def track_confidence(length: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the confidence of points by their track lengths [P] and mean errors [P] in pixels."""
    return np.asarray(length / (1.0 + error))


def straightened(
    tracks: Tracks, xyz: np.ndarray, cameras: list[Camera], lenses: list[Lens | None]
) -> Tracks:
    """Move observations from photos as taken to undistorted photos.

    Lens models are explicit only from the ray to the pixel. So each observation is moved by the
    distortion at its point's projection, which keeps its reprojection error to first order.
    Observations of points behind the camera or outside the lens's view are dropped.

    Args:
        tracks: in pixels of the photos as taken.
        xyz: float64 [P, 3], the points, world frame.
        cameras: pinhole, one for each of ``tracks.names``.
        lenses: their lenses; None has no distortion.
    """
    xy = tracks.xy.copy()
    keep = np.ones(len(xy), dtype=bool)
    for index, (camera, lens) in enumerate(zip(cameras, lenses, strict=True)):
        if lens is None or lens.is_pinhole:
            continue
        rows = np.flatnonzero(tracks.view == index)
        local = xyz[tracks.point[rows]] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        in_front = local[:, 2] > 0.0
        x, y = local[:, :2].T / np.where(in_front, local[:, 2], 1.0)
        bent_x, bent_y, valid = lens.distort(x, y)
        focal = camera.K[[0, 1], [0, 1]]
        xy[rows] -= np.stack([bent_x - x, bent_y - y], axis=1) * focal
        keep[rows] = in_front & valid & np.isfinite(xy[rows]).all(axis=1)
    return Tracks(tracks.names, tracks.view[keep], tracks.point[keep], xy[keep])


def resized(
    points: Points | None, before: Mapping[str, Camera], after: Mapping[str, Camera]
) -> Points | None:
    """Return points with tracks in pixels of resized photos.

    Only the sizes of the cameras before and after, by name, count. Photos that are not in both keep
    their pixels.
    """
    if points is None or points.tracks is None:
        return points
    tracks = points.tracks
    scale = np.ones((len(tracks.names), 2))
    for index, name in enumerate(tracks.names):
        if name in before and name in after:
            old, new = before[name], after[name]
            scale[index] = new.width / old.width, new.height / old.height
    if (scale == 1.0).all():
        return points
    return replace(points, tracks=replace(tracks, xy=tracks.xy * scale[tracks.view]))
