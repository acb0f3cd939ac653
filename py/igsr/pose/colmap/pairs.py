"""Which pairs of photos are matched: of few photos all, of many those that look alike.

Of many photos, those near in the order of names are taken and those whose largest features match
(Wu, "Towards Linear-time Incremental Structure from Motion", 3DV 2013, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.pose.colmap.database import photo_file

#: Up to this many photos, every pair is matched.
EXHAUSTIVE = 60
#: Of more photos, each is matched with those that follow it by name and those most similar to it.
FOLLOWING = 8
MOST_SIMILAR = 16
#: Number of largest features by which similar photos are found, and least matches of them.
PRESELECTION_FEATURES = 128
LEAST_SIMILAR = 4
#: Photos on each side of a tile of pairs. COLMAP indexes the descriptors of every photo that a call
#: names: a call of 40 pairs in their order took 1.5 times as long as all pairs at once, one of a
#: tile 1.2 times. Between two tiles, Ctrl-C is heard.
TILE = 8


def pairs_to_match(count: int, database: Path) -> list[tuple[int, int]]:
    """The pairs of photos to match, as indices; see the module."""
    if count <= EXHAUSTIVE:
        return [(a, b) for a in range(count) for b in range(a + 1, count)]
    pairs = {(a, b) for a in range(count) for b in range(a + 1, min(a + 1 + FOLLOWING, count))}
    similar = similarity(largest_features(count, database))
    for a in range(count):
        best = np.argsort(-similar[a], kind="stable")[:MOST_SIMILAR]
        pairs |= {(min(a, int(b)), max(a, int(b))) for b in best if similar[a, b] >= LEAST_SIMILAR}
    return sorted(pairs)


def in_tiles(pairs: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """The same pairs in groups that name few photos each: squares of ``TILE`` by ``TILE``."""
    tiles: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, b in sorted(pairs):
        tiles.setdefault((a // TILE, b // TILE), []).append((a, b))
    return [tiles[key] for key in sorted(tiles)]


def largest_features(count: int, database: Path) -> list[npt.NDArray[np.float32]]:
    """Descriptors of length 1 of each photo's largest features."""
    pycolmap = load_pycolmap()
    largest_of = []
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        for index in range(count):
            image_id = ids.get(photo_file(index))
            if image_id is None:
                largest_of.append(np.zeros((0, 128), dtype=np.float32))
                continue
            keypoints = opened.read_keypoints(image_id)
            descriptors = opened.read_descriptors(image_id).data.astype(np.float32)
            # The determinant of a feature's affine shape is the square of its size.
            size = np.abs(np.linalg.det(keypoints[:, 2:6].reshape(-1, 2, 2)))
            largest = descriptors[np.argsort(-size, kind="stable")[:PRESELECTION_FEATURES]]
            lengths = np.linalg.norm(largest, axis=1, keepdims=True)
            largest_of.append(largest / np.maximum(lengths, 1e-9))
    return largest_of


def similarity(descriptors: list[npt.NDArray[np.float32]]) -> npt.NDArray[np.int64]:
    """How many of the largest features of each two photos are each other's clear best, [N, N]."""
    count, most = len(descriptors), max(len(features) for features in descriptors)
    padded = np.zeros((count, most, 128), dtype=np.float32)
    for index, features in enumerate(descriptors):
        padded[index, : len(features)] = features
    counts = np.zeros((count, count), dtype=np.int64)
    rows = np.arange(most)
    for a in range(count - 1):
        others = padded[a + 1 :]
        similar = (others @ padded[a].T).swapaxes(1, 2)  # [photo, feature of a, feature of photo]
        best = similar.argmax(axis=2)
        mutual = np.take_along_axis(similar.argmax(axis=1), best, axis=1) == rows
        first = np.take_along_axis(similar, best[..., None], axis=2)[..., 0]
        np.put_along_axis(similar, best[..., None], -1.0, axis=2)
        near, next_near = (np.maximum(2.0 - 2.0 * s, 0.0) for s in (first, similar.max(axis=2)))
        # Of squared distances, Lowe's ratio is 0.8 squared.
        counts[a, a + 1 :] = (mutual & (near < 0.64 * next_near)).sum(axis=1)
    return counts + counts.T
