"""Points inside the visual hull of photos with alpha, near the surface of what they show."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.fitting.initialization.camera_coverage import looked_at_box, pixels_of

Float64 = npt.NDArray[np.float64]

#: Up to so many photos their colors are compared: more cost time and see other sides of the scene.
COMPARED_VIEWS = 24
#: Fraction of the hull's points that is taken, by how well photos agree on their colors.
AGREEING = 0.5
#: Fewer points inside the hull than this are none: the cameras do not agree on any.
MIN_POINTS = 100


def hull_points(
    views: list[View], count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Points whose pixel has alpha in every photo that sees them, with the mean color of those.

    Few photos leave a hull that is much larger than the object. Of its points those are taken on
    whose color photos agree best.

    Args:
        views: photos with alpha.
        count: number of points.
        random: what draws them.

    Returns:
        Points [count, 3] in the world frame and colors [count, 3] in 0..1; grey points in the box
        that the cameras look at where there is no hull.
    """
    compare = len(views) <= COMPARED_VIEWS
    tries = 16 if compare else 4
    # Thin objects fill little of the box: shrink it to what survives and draw again.
    low, high = looked_at_box([view.camera for view in views])
    found, colors = np.zeros((0, 3)), np.zeros((0, 3))
    for _ in range(8):
        candidates = random.uniform(low, high, size=(tries * count, 3))
        for view in views:
            index, in_view = pixels_of(view, candidates)
            candidates = candidates[~in_view | (view.image.reshape(-1, 4)[index, 3] > 0)]
        seen_colors = np.full((len(views), len(candidates), 3), np.nan, dtype=np.float32)
        for v, view in enumerate(views):
            index, in_view = pixels_of(view, candidates)
            seen_colors[v, in_view] = view.image.reshape(-1, 4)[index[in_view], :3] / 255.0
        kept = np.isfinite(seen_colors[..., 0]).any(axis=0)
        if compare and kept.any():
            disagreement = color_disagreement(seen_colors)
            kept &= disagreement <= np.quantile(disagreement[kept], AGREEING, method="lower")
        candidates, seen_colors = candidates[kept], seen_colors[:, kept]
        found = np.concatenate([found, candidates])
        if len(candidates):
            colors = np.concatenate([colors, np.nanmean(seen_colors, axis=0, dtype=np.float64)])
        if len(found) >= count:
            break
        if len(candidates):
            margin = 0.1 * (high - low)
            low = np.maximum(low, candidates.min(axis=0) - margin)
            high = np.minimum(high, candidates.max(axis=0) + margin)
    if len(found) < MIN_POINTS:
        # The cameras do not agree on any hull; a box to start from is better than nothing.
        return random.uniform(low, high, size=(count, 3)), np.full((count, 3), 0.5)
    return found[:count], colors[:count]


def color_disagreement(colors: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """How far [P] the colors of each point differ in the half of the photos that agree best on it.

    In the other half something may stand before the point.

    Args:
        colors: [V, P, 3] in V photos, NaN where a photo does not see the point.
    """
    half = min(len(colors), max(2, len(colors) // 2))
    least = np.full(colors.shape[1], np.inf, dtype=np.float32)
    for own in colors:
        apart = np.abs(colors - own).mean(axis=2)
        apart = np.where(np.isnan(apart), np.float32(np.inf), apart)
        least = np.minimum(least, np.partition(apart, half - 1, axis=0)[:half].mean(axis=0))
    return least
