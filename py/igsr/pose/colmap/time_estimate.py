"""How long cameras take to be found, from the photos' number and sizes."""

from __future__ import annotations

import os
from collections.abc import Sequence

from igsr.pose.colmap.features import MAX_SIDE_PX
from igsr.pose.colmap.pairs import EXHAUSTIVE, FOLLOWING, MOST_SIMILAR

#: Seconds of one core for the features of a photo of a million pixels, for matching a pair of
#: photos, and for adding a photo to the model; measured on one machine.
FEATURES, PAIR, PLACED = 0.9, 0.15, 0.3


def camera_seconds(sizes: Sequence[tuple[int, int]]) -> float:
    """Seconds that COLMAP takes on this machine's cores, by a rough count.

    Args:
        sizes: width and height in pixels of each photo.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    count, pixels = len(sizes), 0.0
    for width, height in sizes:
        scale = min(1.0, MAX_SIDE_PX / max(width, height))
        pixels += width * height * scale * scale
    pairs = count * (count - 1) / 2 if count <= EXHAUSTIVE else count * (FOLLOWING + MOST_SIMILAR)
    parallel = FEATURES * pixels / 1e6 + PAIR * pairs
    return parallel / max(1, cores or 1) + PLACED * count
