"""Points in the visual hull of photos with alpha, near the surface of the object."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, View
from igsr.fitting.initialization.photo_pixels import project_to_photo
from igsr.geometry.focus_point import focus_point

Float64 = npt.NDArray[np.float64]

#: Maximum number of photos for comparing colors: more cost time and show other sides.
MAX_COMPARED_PHOTOS = 24
#: Fraction of the hull's points that is kept, by agreement of the photos' colors.
KEPT_FRACTION = 0.5
#: With fewer points, the hull counts as empty.
MIN_POINTS = 100
#: Rounds of drawing points in a box that shrinks to the points kept.
ROUNDS = 8


def viewed_box(cameras: list[Camera]) -> tuple[Float64, Float64]:
    """Lowest and highest corner [3], world frame, of a cube around the cameras' focus point.

    It is as large as what their photos show at that distance.
    """
    target = focus_point(cameras)
    distances = [float(np.linalg.norm(camera.centre - target)) for camera in cameras]
    tangents = [0.5 * max(c.width / c.K[0, 0], c.height / c.K[1, 1]) for c in cameras]
    half_side = float(np.median(distances) * np.median(tangents))
    return target - half_side, target + half_side


def hull_points(
    views: list[View], count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Return points whose pixels have alpha in every photo that shows them.

    The hull of few photos is much larger than the object, so points are preferred on whose color
    the photos agree.

    Args:
        views: photos with alpha.
        count: number of points.
        random: draws the points.

    Returns:
        Points [count, 3] in the world frame and their mean colors [count, 3] in 0..1; gray points
        in ``viewed_box`` if the hull is empty.
    """
    compare = len(views) <= MAX_COMPARED_PHOTOS
    draws = (16 if compare else 4) * count
    low, high = viewed_box([view.camera for view in views])
    points, colors = np.zeros((0, 3)), np.zeros((0, 3))
    for _ in range(ROUNDS):
        candidates = random.uniform(low, high, size=(draws, 3))
        for view in views:
            index, visible = project_to_photo(view, candidates)
            candidates = candidates[~visible | (view.image.reshape(-1, 4)[index, 3] > 0)]
        photo_colors = np.full((len(views), len(candidates), 3), np.nan, dtype=np.float32)
        for v, view in enumerate(views):
            index, visible = project_to_photo(view, candidates)
            photo_colors[v, visible] = view.image.reshape(-1, 4)[index[visible], :3] / 255.0
        kept = np.isfinite(photo_colors[..., 0]).any(axis=0)
        if compare and kept.any():
            disagreement = color_disagreement(photo_colors)
            kept &= disagreement <= np.quantile(disagreement[kept], KEPT_FRACTION, method="lower")
        candidates, photo_colors = candidates[kept], photo_colors[:, kept]
        points = np.concatenate([points, candidates])
        if len(candidates):
            colors = np.concatenate([colors, np.nanmean(photo_colors, axis=0, dtype=np.float64)])
        if len(points) >= count:
            break
        if len(candidates):  # thin objects fill little of the box
            margin = 0.1 * (high - low)
            low = np.maximum(low, candidates.min(axis=0) - margin)
            high = np.minimum(high, candidates.max(axis=0) + margin)
    if len(points) < MIN_POINTS:
        return random.uniform(low, high, size=(count, 3)), np.full((count, 3), 0.5)
    return points[:count], colors[:count]


def color_disagreement(colors: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Mean color difference [P] of each point in the half of the photos that agree best on it.

    The point may be occluded in the other half.

    Args:
        colors: [V, P, 3] in V photos, NaN where a photo does not show the point.
    """
    half = min(len(colors), max(2, len(colors) // 2))
    lowest = np.full(colors.shape[1], np.inf, dtype=np.float32)
    for reference in colors:
        difference = np.abs(colors - reference).mean(axis=2)
        difference = np.where(np.isnan(difference), np.float32(np.inf), difference)
        best_half = np.partition(difference, half - 1, axis=0)[:half]
        lowest = np.minimum(lowest, best_half.mean(axis=0))
    return lowest
