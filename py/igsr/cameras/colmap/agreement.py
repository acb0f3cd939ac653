"""How many of the verified matches agree with a model.

The mapper triangulates some of the matches and ignores the others. Two parts of a model that share
few points can be at wrong places to each other, and photos of similar sides of an object at the
same place: then matches that the mapper ignored disagree with the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.contradictions import Pair

Float64 = npt.NDArray[np.float64]

#: Maximum distance of a match to its epipolar line, pixels (of verification).
MAX_DISTANCE_PX = 4.0
#: Minimum angle between two rays whose point must lie in front of both cameras, degrees.
MIN_ANGLE = 0.5
#: Minimum fraction of a model's matches that agree with it for the search to end.
GOOD_FRACTION = 0.9
#: A photo is removed if at most this fraction of its matches with the others agree.
MAX_WRONG_FRACTION = 0.5


def agreeing(
    model: Any, matches: Mapping[Pair, npt.NDArray[np.uint32]], database: Path
) -> dict[Pair, int]:
    """Count the matches of each pair of placed photos that agree with the model.

    They are near each other's epipolar line and in front of both cameras.

    Args:
        model: pycolmap's reconstruction.
        matches: verified, as from ``links``.
        database: of the keypoints.
    """
    pycolmap = load_pycolmap()
    placed = set(model.reg_image_ids())
    counts: dict[Pair, int] = {}
    with pycolmap.Database.open(database) as opened:
        keypoints = {n: opened.read_keypoints(n)[:, :2].astype(np.float64) for n in sorted(placed)}
    for (a, b), indices in matches.items():
        if a in placed and b in placed:
            rays = [keypoints[n][indices[:, side]] for side, n in enumerate((a, b))]
            counts[a, b] = int(_agree(model.images[a], model.images[b], *rays).sum())
    return counts


def _agree(one: Any, other: Any, first: Float64, second: Float64) -> npt.NDArray[np.bool_]:
    """Which matched pixels [M, 2] agree with the cameras of two images of a model."""
    relative = other.cam_from_world() * one.cam_from_world().inverse()
    R, t = relative.rotation.matrix(), relative.translation
    left = np.pad(one.camera.cam_from_img(first), ((0, 0), (0, 1)), constant_values=1.0)
    right = np.pad(other.camera.cam_from_img(second), ((0, 0), (0, 1)), constant_values=1.0)
    turned = left @ R.T
    normal = np.cross(t, turned)  # of the epipolar plane, in the second camera
    back = np.cross(right, t) @ R
    slope = np.sqrt((normal[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    focal = 0.5 * (one.camera.mean_focal_length() + other.camera.mean_focal_length())
    distance = np.abs((normal * right).sum(axis=1)) * focal / np.maximum(slope, 1e-12)
    # depth * turned + t is on the ray of right.
    across = np.cross(right, turned)
    length = np.maximum((across**2).sum(axis=1), 1e-18)
    depth = -(across * np.cross(right, t)).sum(axis=1) / length
    in_front = (depth > 0.0) & (depth * turned[:, 2] + t[2] > 0.0)
    sizes = np.linalg.norm(right, axis=1) * np.linalg.norm(turned, axis=1)
    parallel = np.sqrt(length) < np.sin(np.radians(MIN_ANGLE)) * sizes
    agree: npt.NDArray[np.bool_] = (distance < MAX_DISTANCE_PX) & (in_front | parallel)
    return agree


def disagreeing(counts: Mapping[Pair, int], matches: Mapping[Pair, Any]) -> set[int]:
    """Photos whose matches disagree with a model, the worst first until the others agree.

    Args:
        counts: as from ``agreeing``.
        matches: of the pairs.

    Returns:
        COLMAP's image ids.
    """
    removed: set[int] = set()
    while True:
        agreed: dict[int, int] = {}
        verified: dict[int, int] = {}
        for pair, count in counts.items():
            if removed.isdisjoint(pair):
                for photo in pair:
                    agreed[photo] = agreed.get(photo, 0) + count
                    verified[photo] = verified.get(photo, 0) + len(matches[pair])
        worst = min(verified, key=lambda n: (agreed[n] / verified[n], n), default=None)
        if worst is None or agreed[worst] > MAX_WRONG_FRACTION * verified[worst]:
            return removed
        removed.add(worst)
