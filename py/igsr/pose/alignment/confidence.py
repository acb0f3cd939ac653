"""Which depths of aligned photos are confident."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr.pose.alignment.aligned_photo import AlignedPhoto

Bool = npt.NDArray[np.bool_]

#: A depth is confident where its raw confidence (1 says nothing) is above this.
TRUSTED = 3.0
#: A pixel stands before another photo's surface where its depth is below this part of that.
IN_FRONT = 0.95


def trusted_pixels(
    photos: Sequence[AlignedPhoto | None], pairs: Sequence[tuple[int, int]]
) -> list[Bool | None]:
    """The pixels, [h, w] per photo, that are sure and that no surer pixel looks through.

    A pixel that stands where another photo sees something further away is taken to be wrong if it
    is the less confident of the two (``clean_pointcloud`` of DUSt3R's code). All are judged by the
    confidences they came with, so the order of the photos does not matter.

    Args:
        photos: None where one has no place.
        pairs: photos that are held against each other, in both directions.
    """
    trusted = [
        None
        if photo is None
        else np.isfinite(photo.depth) & (photo.depth > 0.0) & (photo.confidence > TRUSTED)
        for photo in photos
    ]
    for i, photo in enumerate(photos):
        own = trusted[i]
        if photo is None or own is None:
            continue
        xyz, index = photo.world_points()
        for j in sorted({a + b - i for a, b in pairs if i in (a, b)}):
            other = photos[j]
            if other is not None:
                own.ravel()[index[_looked_through(xyz, photo.confidence.ravel()[index], other)]] = (
                    False
                )
    return trusted


def _looked_through(
    xyz: npt.NDArray[np.float64], confidence: npt.NDArray[np.float32], other: AlignedPhoto
) -> Bool:
    """Which world points [M, 3] stand before a surface that another photo is surer of."""
    shown, z, surface, surer = other.shown_at(xyz)
    with np.errstate(invalid="ignore", over="ignore"):  # the other photo's depth may be unknown
        return shown & (z < IN_FRONT * surface) & (confidence < surer)
