"""How many of the verified matches agree with a model.

The mapper ignores many matches. If two parts of a model share few points, or if two sides of an
object look similar, it can place photos wrongly: then the ignored matches disagree with the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.contradictions import Pair
from igsr.cameras.colmap.matcher import BEST_FEATURES

Float64 = npt.NDArray[np.float64]

#: Maximum distance of a match to its epipolar line, pixels (of verification).
MAX_DISTANCE_PX = 4.0
#: Minimum angle between two rays whose point must lie in front of both cameras, degrees.
MIN_ANGLE = 0.5
#: Minimum fraction of a model's matches that agree with it for the search to end.
GOOD_FRACTION = 0.9
#: Of the learned features that two photos should both show, at least this fraction is matched from
#: one direction. It falls with the angle. In correct models it was at least 1.7 times as high.
SHARED_FRACTION = 0.25
FALLING_ANGLE = 15.0
#: Pairs within this angle, degrees, and this ratio of scales are checked.
MAX_CLOSE_ANGLE = 20.0
MAX_ZOOM = 1.5
#: Minimum number of these features.
MIN_SHARED = 100
#: Groups of photos belong together if at least this fraction of the matches between them agree.
JOINING_FRACTION = 0.7
#: The same if two pairs without a common photo agree: each with this many matches, and this part
#: of its matches.
JOINING_FRACTION_OF_TWO = 0.35
MIN_SURE = 30
SURE = 0.85
#: A photo stays if at least this fraction of its matches agrees with photos that stay: of the pairs
#: that have this fraction of its strongest pair's matches.
MIN_OWN_FRACTION = 0.5
STRONG_FRACTION = 0.3


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


def consistent_part(counts: Mapping[Pair, int], matches: Mapping[Pair, Any]) -> set[int]:
    """Find the largest part of a model whose photos agree with each other.

    Photos are joined, most agreeing matches first, unless the matches between the two groups
    mostly disagree with the model: then a few look-alike matches hold wrong parts together. Two
    pairs of four photos that agree weigh more, since wrong pairs seldom agree with each other.
    Photos whose strong pairs are mostly with others, left out, are left out too.

    Args:
        counts: of the pairs of placed photos, as from ``agreeing``.
        matches: of all pairs.

    Returns:
        COLMAP's image ids.
    """
    groups = {frozenset([photo]) for pair in counts for photo in pair}
    while True:
        best, most = None, 0
        for one, other in combinations(sorted(groups, key=min), 2):
            between = [
                pair
                for pair in counts
                if (pair[0] in one and pair[1] in other) or (pair[0] in other and pair[1] in one)
            ]
            agreed = sum(counts[pair] for pair in between)
            verified = sum(len(matches[pair]) for pair in between)
            sure = [p for p in between if counts[p] >= max(MIN_SURE, SURE * len(matches[p]))]
            apart = any(set(p).isdisjoint(q) for p, q in combinations(sure, 2))
            fraction = JOINING_FRACTION_OF_TWO if apart else JOINING_FRACTION
            if agreed > most and agreed >= fraction * verified:
                best, most = (one, other), agreed
        if best is None:
            break
        groups = (groups - set(best)) | {best[0] | best[1]}
    inside = {
        group: sum(counts[pair] for pair in counts if group.issuperset(pair)) for group in groups
    }
    part = set(max(inside, key=lambda group: (inside[group], -min(group)), default=()))
    strong: dict[int, list[Pair]] = {}
    for photo in part:
        own = {pair: len(matches[pair]) for pair in matches if photo in pair}
        limit = STRONG_FRACTION * max(own.values())
        strong[photo] = [pair for pair, count in own.items() if count >= limit]
    while len(part) > 2:
        share = {
            photo: sum(counts[pair] for pair in pairs if part.issuperset(pair))
            / sum(len(matches[pair]) for pair in pairs)
            for photo, pairs in strong.items()
            if photo in part
        }
        worst = min(share, key=lambda photo: (share[photo], photo))
        if share[worst] >= MIN_OWN_FRACTION:
            break
        part.remove(worst)
    return part


def missing_matches(
    model: Any, matches: Mapping[Pair, npt.NDArray[np.uint32]], database: Path
) -> set[Pair]:
    """Find pairs of a model's photos with too few learned matches for their cameras.

    Photos of one side of an object from nearly one direction share most of their learned features;
    similar sides share few of them. So such a pair is at a wrong place.

    Args:
        model: pycolmap's reconstruction.
        matches: verified, as from ``links``.
        database: of the features. Those without descriptors are learned.
    """
    pycolmap = load_pycolmap()
    numbers = sorted(model.reg_image_ids())
    features: dict[int, Float64] = {}  # learned, pixels
    first: dict[int, int] = {}
    with pycolmap.Database.open(database) as opened:
        for n in numbers:
            count = opened.num_descriptors_for_image(n)
            best = opened.read_keypoints(n)[count : count + BEST_FEATURES, :2]
            features[n], first[n] = best.astype(np.float64), count
    depth: dict[int, float] = {}
    for n in numbers:
        seen = [p.point3D_id for p in model.images[n].get_observation_points2D()]
        if seen and len(features[n]):
            pose = model.images[n].cam_from_world().matrix()
            xyz = np.array([model.points3D[point].xyz for point in seen])
            depth[n] = float(np.median(xyz @ pose[2, :3] + pose[2, 3]))
    missing: set[Pair] = set()
    for i, a in enumerate(numbers):
        for b in numbers[i + 1 :]:
            if a not in depth or b not in depth:
                continue
            one, other = model.images[a], model.images[b]
            angle = _angle(one, other, depth[a])
            zoom = depth[a] * other.camera.mean_focal_length()
            zoom /= depth[b] * one.camera.mean_focal_length()
            if angle > MAX_CLOSE_ANGLE or not 1.0 / MAX_ZOOM < zoom < MAX_ZOOM:
                continue
            should = min(
                _shown(one, other, features[a], depth[a]),
                _shown(other, one, features[b], depth[b]),
            )
            shared = matches.get((a, b), np.zeros((0, 2), dtype=np.uint32))
            ranks = shared.astype(np.int64) - [first[a], first[b]]
            learned = np.count_nonzero(((ranks >= 0) & (ranks < BEST_FEATURES)).all(axis=1))
            wanted = SHARED_FRACTION * np.exp(-angle / FALLING_ANGLE)
            if should >= MIN_SHARED and learned < wanted * should:
                missing.add((a, b))
    return missing


def _angle(one: Any, other: Any, depth: float) -> float:
    """The angle between two cameras, degrees: of rotation, or between their rays to a point."""
    relative = other.cam_from_world() * one.cam_from_world().inverse()
    turned = np.arccos(np.clip(0.5 * (np.trace(relative.rotation.matrix()) - 1.0), -1.0, 1.0))
    middle = one.cam_from_world().inverse() * np.array([0.0, 0.0, depth])
    rays = [middle - image.projection_center() for image in (one, other)]
    rays = [ray / max(float(np.linalg.norm(ray)), 1e-12) for ray in rays]
    return float(np.degrees(max(turned, np.arccos(np.clip(rays[0] @ rays[1], -1.0, 1.0)))))


def _shown(one: Any, other: Any, pixels: Float64, depth: float) -> int:
    """The number of pixels [N, 2] of an image that another shows, if all have one depth."""
    local = np.pad(one.camera.cam_from_img(pixels), ((0, 0), (0, 1)), constant_values=1.0) * depth
    pose = (other.cam_from_world() * one.cam_from_world().inverse()).matrix()
    seen = local @ pose[:, :3].T + pose[:, 3]
    camera = other.camera
    with np.errstate(all="ignore"):
        x = seen[:, 0] / seen[:, 2] * camera.focal_length_x + camera.principal_point_x
        y = seen[:, 1] / seen[:, 2] * camera.focal_length_y + camera.principal_point_y
    inside = (seen[:, 2] > 0.0) & (x > 0.0) & (y > 0.0) & (x < camera.width) & (y < camera.height)
    return int(np.count_nonzero(inside))
