"""What points are worth by their tracks, and tracks of photos whose lens bends."""

from __future__ import annotations

import numpy as np

from igsr.capture.types import Camera, Tracks
from igsr.capture.undistort import Lens


def track_confidence(length: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Confidence of points that many photos see in nearly one place.

    Args:
        length: number of photos that see each point.
        error: its mean reprojection error, pixels.
    """
    return np.asarray(length / (1.0 + error))


def straightened(
    tracks: Tracks, xyz: np.ndarray, cameras: list[Camera], lenses: list[Lens | None]
) -> Tracks:
    """Observations in pixels of the photos with lens distortion undone.

    Lens models are explicit from the ray to the pixel alone. So each observation is moved by what
    the lens does to its point: what it is off by, which is all that counts, stays as it was to
    first order.

    Args:
        tracks: in pixels of the photos as they were taken.
        xyz: [P, 3], the points.
        cameras: pinhole, one for each of ``tracks.names``.
        lenses: theirs; None bends nothing.

    Returns:
        Tracks without the observations of points behind their camera or beyond what its lens sees.
    """
    xy = tracks.xy.copy()
    keep = np.ones(len(xy), dtype=bool)
    for index, (camera, lens) in enumerate(zip(cameras, lenses, strict=True)):
        if lens is None or lens.is_pinhole:
            continue
        mine = np.flatnonzero(tracks.view == index)
        local = xyz[tracks.point[mine]] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        before = local[:, 2] > 0.0
        x, y = local[:, :2].T / np.where(before, local[:, 2], 1.0)
        bent_x, bent_y, valid = lens.distort(x, y)
        focal = camera.K[[0, 1], [0, 1]]
        xy[mine] -= np.stack([bent_x - x, bent_y - y], axis=1) * focal
        keep[mine] = before & valid & np.isfinite(xy[mine]).all(axis=1)
    return Tracks(tracks.names, tracks.view[keep], tracks.point[keep], xy[keep])
