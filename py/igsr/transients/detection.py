"""Detect transient objects: pixels that show an object that no other photo shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import PseudoView, View
from igsr.capture.downscaling import resampled_plane
from igsr.splats import Splats
from igsr.transients.consensus import (
    RADIUS_PX,
    Consensus,
    Thumbnail,
    colors_at,
    consensus_of,
    shown_at_any_depth,
    thumbnails,
)
from igsr.transients.regions import box_sums, labels, window_max, window_min

Bool = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]

#: Seeds of a region differ from the other photos by more than this, in [0, 1], and by more than
#: this many standard deviations of the scene.
SEED_DISTANCE = 0.10
SEED_SIGMAS = 3.0
#: Regions grow over pixels with at least this difference.
GROWTH_DISTANCE = 0.03
GROWTH_SIGMAS = 1.0
#: Minimum area of a region and of its seeds, as a fraction of the photo.
MIN_REGION_FRACTION = 0.004
MIN_SEED_FRACTION = 0.001
#: A scene has transient objects for certain if the evident seeds of a region cover this fraction of
#: a photo. Measured: at most 0.0005 in static scenes, at least 0.015 with figures in some photos.
EVIDENT_FRACTION = 0.003
#: Seeds are not evident in lines up to twice the first width, nor within the second distance of the
#: photo's border, which undistortion may darken.
LINE_RADIUS_PX = 2
BORDER_PX = 4
#: Half the side of the window in which a majority of the seeds must be shown by no other photo.
VOTE_RADIUS_PX = 4
#: Maximum distance of a region's pixels from its seeds.
GROWTH_PX = 24
#: Radius of the mean that replaces missing colors of the consensus.
MEAN_RADIUS_PX = 4
#: Maximum number of photos for the standard deviation of the scene: a consensus takes more memory
#: than its photo.
MAX_MEASURED = 64
#: Growth of masks at the end, for the mixed colors at edges.
MARGIN_PX = 2


def find_transients(
    splats: Splats,
    views: Sequence[View],
    before: Sequence[Bool | None],
    *,
    min_evident: float = 0.0,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    backend: Backend = "auto",
) -> list[Bool | None]:
    """Find the pixels of transient objects.

    Args:
        splats: the scene so far.
        views: V views with the scene's colors; pseudo-views are ignored.
        before: for each, bool [H, W] of the pixels that were found before, or None; other photos
            are not compared with them.
        min_evident: fraction of a photo. No view gets a mask unless the evident seeds of some
            region cover this much; see ``EVIDENT_FRACTION``.
        background: RGB in [0, 1] behind photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        For each view, bool [H, W], True for transient pixels; None if there are none.
    """
    which = [k for k, view in enumerate(views) if not isinstance(view, PseudoView)]
    photos = thumbnails(
        splats, [views[k] for k in which], [before[k] for k in which], background, backend
    )
    measured = np.linspace(0, len(photos) - 1, min(len(photos), MAX_MEASURED)).round().astype(int)
    known = {int(k): consensus_of(int(k), photos) for k in measured}
    deviation = _deviation([(photos[k], consensus) for k, consensus in known.items()])
    masks: list[Bool | None] = [None] * len(views)
    evident = 0.0
    for k, photo in enumerate(photos):
        consensus = known.pop(k) if k in known else consensus_of(k, photos)
        if consensus is None:
            continue
        mask, fraction = transient_regions(photo, consensus, deviation)
        evident = max(evident, fraction)
        if mask.any():
            camera = views[which[k]].camera
            masks[which[k]] = resampled_plane(mask, camera.width, camera.height)
    return masks if evident >= min_evident else [None] * len(views)


def _deviation(compared: Sequence[tuple[Thumbnail, Consensus | None]]) -> float:
    """Robust standard deviation of colors from those that other photos agree on."""
    differences = [np.zeros(1)]
    for photo, consensus in compared:
        if consensus is not None:
            difference = np.abs(colors_at(photo.color, consensus.pixels) - consensus.color)
            differences.append(difference.max(axis=-1)[consensus.agreed])
    return 1.4826 * float(np.median(np.concatenate(differences)))


def _distances(photo: Thumbnail, consensus: Consensus) -> Float32:
    """Distance of colors from all consensus colors within ``RADIUS_PX``, float32 [H, W]."""
    height, width = photo.usable.shape
    sums = np.zeros((height * width, 4))
    sums[consensus.pixels[consensus.agreed], :3] = consensus.color[consensus.agreed]
    sums[consensus.pixels[consensus.agreed], 3] = 1.0
    whole = sums.reshape(height, width, 4)
    # Means replace missing colors.
    whole = np.where(whole[..., 3:] > 0.0, whole, box_sums(whole, MEAN_RADIUS_PX))
    known = whole[..., 3:] > 0.0
    color = whole[..., :3] / np.maximum(whole[..., 3:], 1.0)
    low = window_min(np.where(known, color, np.inf), RADIUS_PX)
    high = window_max(np.where(known, color, -np.inf), RADIUS_PX)
    own = photo.color / np.float32(255.0)
    distance = np.maximum(low - own, own - high).max(axis=-1)
    return np.where(photo.usable & known[..., 0], distance, 0.0).astype(np.float32)


def transient_regions(
    photo: Thumbnail, consensus: Consensus, deviation: float
) -> tuple[Bool, float]:
    """Find the transient regions of a photo, bool [H, W], by the deviation of the scene's colors.

    Also return the largest area of evident seeds in a region, as a fraction of the photo.
    """
    height, width = photo.usable.shape

    def picture(selected: Bool) -> Bool:
        flat = np.zeros(height * width, np.bool_)
        flat[consensus.pixels[selected]] = True
        return flat.reshape(height, width)

    is_far = consensus.distance > max(SEED_DISTANCE, SEED_SIGMAS * deviation)
    different = picture(consensus.agreed & ~consensus.explained & is_far)
    different = window_max(window_min(different, 1), 1)
    seeds = different.copy()
    pixels = np.flatnonzero(different)
    # A color that is shown at another depth is due to a wrong surface in the scene so far.
    seeds.reshape(-1)[pixels] = ~shown_at_any_depth(photo, pixels, consensus)
    seeds &= 2 * box_sums(seeds, VOTE_RADIUS_PX) >= box_sums(different, VOTE_RADIUS_PX)
    if not seeds.any():
        return seeds, 0.0
    differs = _distances(photo, consensus) > max(GROWTH_DISTANCE, GROWTH_SIGMAS * deviation)
    allowed = different | (differs & ~picture(consensus.explained))
    grown = seeds.copy()
    for _ in range(GROWTH_PX):
        grown |= window_max(grown, 1) & allowed
    number = labels(window_min(window_max(grown, 2), 2))
    count = number.max() + 1

    def fractions(selected: Bool) -> npt.NDArray[np.float64]:
        """Area within each region, as a fraction of the photo."""
        return np.bincount(number[selected], minlength=count) / selected.size

    keep = fractions(number > 0) >= MIN_REGION_FRACTION
    keep &= fractions(seeds) >= MIN_SEED_FRACTION
    keep[0] = False
    evident = seeds.copy()
    evident[:BORDER_PX] = evident[-BORDER_PX:] = False
    evident[:, :BORDER_PX] = evident[:, -BORDER_PX:] = False
    evident = window_max(window_min(evident, LINE_RADIUS_PX), LINE_RADIUS_PX)
    return window_max(keep[number], MARGIN_PX), float(fractions(evident)[keep].max(initial=0.0))
