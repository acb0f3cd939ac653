"""Split many photos into passes of the network, and join the passes in one world."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from igsr.cameras.depth_maps import AlignedPhoto
from igsr.geometry.similarity import Similarity, similarity_of_points

#: Fraction of a pass's photos that all passes share, evenly spread over all photos.
ANCHOR_FRACTION = 1 / 4
#: Fraction of a pass's photos that are the last ones of the pass before.
OVERLAP_FRACTION = 1 / 8
#: Maximum number of pixels of a shared photo that passes are joined by.
MAX_JOINING_PIXELS = 2000
#: Minimum confidence above 1 of these pixels, as a fraction of the less confident pass's median.
MIN_MEDIAN_FRACTION = 0.1


def passes_of(count: int, most: int) -> list[list[int]]:
    """Choose the photos of each pass; every photo is in at least one.

    All passes share the same anchors, so that each is joined to the first and errors do not
    accumulate, and contain the last photos of the pass before, since neighbors overlap.

    Args:
        count: number of photos.
        most: maximum number of photos of a pass, at least 2.
    """
    if count <= most:
        return [list(range(count))]
    anchors = max(1, round(most * ANCHOR_FRACTION))
    fixed = sorted({round(i) for i in np.linspace(0, count - 1, anchors)})
    others = [i for i in range(count) if i not in fixed]
    room = most - len(fixed)
    overlap = min(round(most * OVERLAP_FRACTION), room - 1)
    passes = -(-len(others) // (room - overlap))
    cuts = np.linspace(0, len(others), passes + 1).round().astype(int)
    return [
        sorted({*fixed, *others[max(0, begin - overlap) : end]}) for begin, end in pairwise(cuts)
    ]


def joined_passes(
    passes: Sequence[dict[int, AlignedPhoto]],
) -> tuple[dict[int, AlignedPhoto], list[int]]:
    """Map all passes, each with its photos by index, to the world of the first one.

    Returns:
        The photos by index, as in the first pass that contains them; and the indices of photos
        that could not be joined.
    """
    world: dict[int, AlignedPhoto] = {}
    lost: set[int] = set()
    for photos in passes:
        if not world:
            world = dict(photos)
            continue
        similarity = _joining_similarity(
            [(photos[i], world[i]) for i in sorted(photos.keys() & world.keys())]
        )
        if similarity is None:
            lost |= photos.keys() - world.keys()
            continue
        for i in photos.keys() - world.keys():
            world[i] = photos[i].mapped(similarity)
    return world, sorted(lost - world.keys())


def _joining_similarity(pairs: Sequence[tuple[AlignedPhoto, AlignedPhoto]]) -> Similarity | None:
    """The similarity from one pass to another by their shared photos; None without shared pixels.

    Distances between the points of the same pixels are in units of depth, since errors of depth
    grow with depth.
    """
    points, targets, weights = [], [], []
    for one, other in pairs:
        stride = max(1, one.depth.size // MAX_JOINING_PIXELS)
        xyz, index = one.world_points()
        other_xyz, other_index = other.world_points()
        _, at, other_at = np.intersect1d(index, other_index, return_indices=True)
        at, other_at = at[::stride], other_at[::stride]
        if not len(at):
            continue
        excess, other_excess = (
            photo.confidence.ravel()[pixels].astype(np.float64) - 1.0
            for photo, pixels in ((one, index[at]), (other, other_index[other_at]))
        )
        least = MIN_MEDIAN_FRACTION * min(np.median(excess), np.median(other_excess))
        used = (excess > least) & (other_excess > least)
        depth = other.depth.ravel()[other_index[other_at]].astype(np.float64)
        points.append(xyz[at].T)
        targets.append(other_xyz[other_at].T)
        weights.append(np.where(used, np.sqrt(np.maximum(excess * other_excess, 0.0)), 0.0) / depth)
    if not points:
        return None
    return similarity_of_points(
        np.concatenate(points, axis=1), np.concatenate(targets, axis=1), np.concatenate(weights)
    )
