"""Choose pairs of photos to match: all of few photos, similar ones of many.

Of many photos, each is matched with the next ones by name and with photos whose largest features
match (Wu, "Towards Linear-time Incremental Structure from Motion", 3DV 2013, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import photo_file
from igsr.cameras.colmap.features import feature_areas

#: Maximum number of photos for matching every pair.
MAX_EXHAUSTIVE_PHOTOS = 60
#: Of more photos, each is matched with this many that follow it and that are similar.
FOLLOWING_PHOTOS = 8
SIMILAR_PHOTOS = 16
#: The same for learned matches, which take longer.
MAX_EXHAUSTIVE_LEARNED = 12
SIMILAR_LEARNED = 12
#: Number of largest features for finding similar photos, and the minimum matches of these.
PRESELECTION_FEATURES = 128
MIN_PRESELECTION_MATCHES = 4
#: Photos on each side of a tile of pairs. COLMAP indexes the descriptors of every photo in a call,
#: so a call per 40 pairs took 1.5 times as long as all pairs at once, and tiles 1.2 times. Ctrl-C
#: is handled between tiles.
TILE_PHOTOS = 8


def pairs_to_match(count: int, database: Path) -> list[tuple[int, int]]:
    """Return the pairs of photos to match, as indices."""
    if count <= MAX_EXHAUSTIVE_PHOTOS:
        return [(a, b) for a in range(count) for b in range(a + 1, count)]
    pairs = {
        (a, b) for a in range(count) for b in range(a + 1, min(a + 1 + FOLLOWING_PHOTOS, count))
    }
    similar = similarity(largest_features(count, database))
    for a in range(count):
        for b in np.argsort(-similar[a], kind="stable")[:SIMILAR_PHOTOS]:
            if similar[a, b] >= MIN_PRESELECTION_MATCHES:
                pairs.add((min(a, int(b)), max(a, int(b))))
    return sorted(pairs)


def similar_pairs(descriptors: Sequence[npt.NDArray[np.float32]]) -> list[tuple[int, int]]:
    """Return the pairs of photos for a learned matcher, as indices.

    Args:
        descriptors: [N, D] of each photo, the best first.
    """
    count = len(descriptors)
    if count <= MAX_EXHAUSTIVE_LEARNED:
        return [(a, b) for a in range(count) for b in range(a + 1, count)]
    similar = similarity([_normalized(one[:PRESELECTION_FEATURES]) for one in descriptors])
    pairs = set()
    for a in range(count):
        for b in np.argsort(-similar[a], kind="stable")[:SIMILAR_LEARNED]:
            pairs.add((min(a, int(b)), max(a, int(b))))
    return sorted(pair for pair in pairs if pair[0] != pair[1])


def _normalized(descriptors: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return descriptors / np.maximum(lengths, 1e-9).astype(np.float32)


def in_tiles(pairs: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Group pairs into tiles of ``TILE_PHOTOS`` by ``TILE_PHOTOS`` photos."""
    tiles: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, b in sorted(pairs):
        tiles.setdefault((a // TILE_PHOTOS, b // TILE_PHOTOS), []).append((a, b))
    return [tiles[key] for key in sorted(tiles)]


def largest_features(count: int, database: Path) -> list[npt.NDArray[np.float32]]:
    """Return the normalized descriptors of each photo's largest features."""
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
            order = np.argsort(-feature_areas(keypoints), kind="stable")
            largest_of.append(_normalized(descriptors[order[:PRESELECTION_FEATURES]]))
    return largest_of


def similarity(descriptors: list[npt.NDArray[np.float32]]) -> npt.NDArray[np.int64]:
    """Count the mutual matches of the largest features of each pair of photos, [N, N]."""
    count, longest = len(descriptors), max(len(features) for features in descriptors)
    padded = np.zeros((count, longest, descriptors[0].shape[1]), dtype=np.float32)
    for index, features in enumerate(descriptors):
        padded[index, : len(features)] = features
    counts = np.zeros((count, count), dtype=np.int64)
    rows = np.arange(longest)
    for a in range(count - 1):
        others = padded[a + 1 :]
        similar = (others @ padded[a].T).swapaxes(1, 2)  # [photo, feature of a, feature of photo]
        best = similar.argmax(axis=2)
        mutual = np.take_along_axis(similar.argmax(axis=1), best, axis=1) == rows
        first = np.take_along_axis(similar, best[..., None], axis=2)[..., 0]
        np.put_along_axis(similar, best[..., None], -1.0, axis=2)
        near, next_near = (np.maximum(2.0 - 2.0 * s, 0.0) for s in (first, similar.max(axis=2)))
        # Lowe's ratio of 0.8, of squared distances.
        counts[a, a + 1 :] = (mutual & (near < 0.64 * next_near)).sum(axis=1)
    return counts + counts.T
