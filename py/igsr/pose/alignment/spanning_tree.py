"""Which photos hang together, and the strongest tree that connects them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt


def components(photos: int, edges: Sequence[tuple[int, int]]) -> list[list[int]]:
    """The photos in groups that edges connect, the largest group first.

    Args:
        photos: how many there are.
        edges: pairs of them.
    """
    label = np.arange(photos)
    for first, second in edges:
        label[label == label[second]] = label[first]
    groups: dict[int, list[int]] = {}
    for photo in range(photos):
        groups.setdefault(int(label[photo]), []).append(photo)
    return sorted(groups.values(), key=len, reverse=True)


def spanning_tree(
    edges: npt.NDArray[np.int64], scores: npt.NDArray[np.float64]
) -> list[tuple[int, bool]]:
    """The edges of the tree with the greatest scores, each touching those before it (Prim).

    Args:
        edges: [E, 2], directed, of photos that are all connected; the better direction counts.
        scores: [E].

    Returns:
        Per edge of the tree its index, and whether its first photo is one that the edges before
        have reached; so also for the strongest edge, with which the tree begins.
    """
    order = np.argsort(-scores, kind="stable")
    reached = {int(edges[order[0], 0])}
    everything = {int(photo) for photo in edges.ravel()}
    tree = []
    while reached != everything:
        for e in order:
            first, second = (int(photo) for photo in edges[e])
            if (first in reached) != (second in reached):
                tree.append((int(e), first in reached))
                reached |= {first, second}
                break
    return tree
