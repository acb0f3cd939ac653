"""Photos that are too many for one pass: which go together, and how passes become one world."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from igsr.geometry.similarity import Similarity, similarity_of_points
from igsr.pose.alignment import AlignedPhoto

Float64 = npt.NDArray[np.float64]

#: Part of a pass's photos that every pass has, evenly spread over all.
ANCHORS = 1 / 4
#: Part that are the last of the pass before.
OVERLAP = 1 / 8
#: Pixels of a shared photo that passes are joined by.
SAMPLES = 2000
#: Confidence, less 1, in units of the less sure pass's median, below which a pixel is not used.
UNSURE = 0.1


def chunks_of(count: int, most: int) -> list[list[int]]:
    """Indices of the photos of each pass, ascending; every photo is in one at least.

    Every pass has the same anchors, so that each is joined to the first and errors do not add up,
    and the last photos of the pass before, since photos that follow each other show the same.

    Args:
        count: photos.
        most: photos of a pass, at least 2.
    """
    if count <= most:
        return [list(range(count))]
    anchors = max(1, round(most * ANCHORS))
    fixed = sorted({round(i) for i in np.linspace(0, count - 1, anchors)})
    others = [i for i in range(count) if i not in fixed]
    room = most - len(fixed)
    overlap = min(round(most * OVERLAP), room - 1)
    passes = -(-len(others) // (room - overlap))
    cuts = np.linspace(0, len(others), passes + 1).round().astype(int)
    return [
        sorted({*fixed, *others[max(0, begin - overlap) : end]}) for begin, end in pairwise(cuts)
    ]


def joining_similarity(
    pairs: Sequence[tuple[AlignedPhoto, AlignedPhoto]],
) -> Similarity | None:
    """The similarity that brings one pass's world to another's.

    It is that of the points of the same pixels, with distances in units of depth, for that is what
    errors of depth grow with.

    Args:
        pairs: per photo that is in both passes, what the one and the other say of it.

    Returns:
        None where nothing is shared that both are sure of.
    """
    points, others, weights = [], [], []
    for one, other in pairs:
        stride = max(1, one.depth.size // SAMPLES)
        found, index = one.world_points()
        found_in_other, index_in_other = other.world_points()
        _, at, at_other = np.intersect1d(index, index_in_other, return_indices=True)
        at, at_other = at[::stride], at_other[::stride]
        if not len(at):
            continue
        sure, other_sure = (
            photo.confidence.ravel()[places].astype(np.float64) - 1.0
            for photo, places in ((one, index[at]), (other, index_in_other[at_other]))
        )
        least = UNSURE * min(np.median(sure), np.median(other_sure))
        used = (sure > least) & (other_sure > least)
        depth = other.depth.ravel()[index_in_other[at_other]].astype(np.float64)
        points.append(found[at].T)
        others.append(found_in_other[at_other].T)
        weights.append(np.where(used, np.sqrt(np.maximum(sure * other_sure, 0.0)), 0.0) / depth)
    if not points:
        return None
    return similarity_of_points(
        np.concatenate(points, axis=1), np.concatenate(others, axis=1), np.concatenate(weights)
    )


def joined(
    passes: Sequence[dict[int, AlignedPhoto]],
) -> tuple[dict[int, AlignedPhoto], list[int]]:
    """All photos in one world, that of the first pass; each as the first pass that has it says.

    Args:
        passes: per pass the photos that it has, by index; each in a world of its own.

    Returns:
        The photos by index, and those that no similarity could be found for, ascending.
    """
    world: dict[int, AlignedPhoto] = {}
    lost: set[int] = set()
    for photos in passes:
        if not world:
            world = dict(photos)
            continue
        shared = [(photos[i], world[i]) for i in sorted(photos.keys() & world.keys())]
        similarity = joining_similarity(shared)
        if similarity is None:
            lost |= photos.keys() - world.keys()
            continue
        for i in photos.keys() - world.keys():
            world[i] = photos[i].mapped(similarity)
    return world, sorted(lost - world.keys())
