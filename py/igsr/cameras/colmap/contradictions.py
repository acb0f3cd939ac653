"""Detect wrong matches between places that look alike, by the matches that are missing.

A pattern that an object has twice, or two doors of one make, give matches that agree with the
geometry of a pair, and a model that places photos of one side on another side. Such a model
contradicts itself: by its cameras, photos see the same points from nearly the same direction, but
they share few of them (Zach et al., "What Can Missing Correspondences Tell Us About 3D Structure
and Motion?", CVPR 2008), and those few lie in one place, the pattern. (Photos of other light or
sharpness also share few points, but all over.) Photos are then divided into parts without
contradictions, strongest links first, and the matches between the parts are left out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]

#: COLMAP's numbers of two photos, the smaller first.
Pair: TypeAlias = tuple[int, int]

#: Two photos should share points that both see from within this angle, degrees.
MAX_ANGLE = 25.0
#: The same, maximum ratio of their scales in the photos: SIFT tolerates such changes.
MAX_ZOOM = 1.6
#: Minimum fraction of these points that is shared. In correct models it was at least 0.26, for
#: wrong pairs of a model with misplaced photos at most 0.12.
MIN_SHARED_FRACTION = 0.15
#: Minimum number of these points for a contradiction.
MIN_POINTS = 100
#: Shared points of a wrong pair spread over less than this fraction of the area of the points that
#: should be shared. It was at least 0.66 for right pairs, and at most 0.41 for wrong ones.
MAX_SPREAD_FRACTION = 0.5
#: Minimum number of shared points to judge their spread.
MIN_SHARED_POINTS = 5
#: Photos stay together in spite of a contradiction if links of at least this fraction of their
#: strongest ones connect them: then something stands between the cameras.
MIN_LINK_FRACTION = 0.25
#: Distance from the border of a photo within which a point may be lost, pixels.
BORDER_PX = 10.0


def links(database: Path) -> dict[Pair, npt.NDArray[np.uint32]]:
    """Read the matches [M, 2] of each pair of photos, as indices of features."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        return {
            pycolmap.pair_id_to_image_pair(pair): np.asarray(geometry.inlier_matches)
            for pair, geometry in zip(ids, geometries, strict=True)
            if len(geometry.inlier_matches)
        }


def leave_out(database: Path, pairs: Iterable[Pair]) -> None:
    """Remove the matches of pairs from a database."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as opened:
        for a, b in sorted(pairs):
            opened.update_two_view_geometry(a, b, pycolmap.TwoViewGeometry())


def contradictions(
    model: Any, matches: Mapping[Pair, npt.NDArray[np.uint32]], usable: Mapping[int, Bool]
) -> set[Pair]:
    """Find pairs of a model's photos that share few of the points that both should see.

    Args:
        model: pycolmap's reconstruction; models with rigs are not checked.
        matches: of pairs of photos, as from ``links``.
        usable: pixels [H, W] that can have features, for photos with a mask.
    """
    numbers = sorted(model.reg_image_ids())
    rows = {point: row for row, point in enumerate(sorted(model.point3D_ids()))}
    if not rows or model.num_reg_frames() < len(numbers):
        return set()
    xyz = np.stack([model.points3D[point].xyz for point in rows])
    # The point of each feature, -1 for none, and which points each photo sees.
    point_of = {
        n: np.array(
            [rows[p.point3D_id] if p.has_point3D() else -1 for p in model.images[n].points2D],
            dtype=np.int64,
        )
        for n in numbers
    }
    sees = {n: np.zeros(len(rows) + 1, dtype=np.bool_) for n in numbers}
    for n in numbers:
        sees[n][point_of[n]] = True
    center = {n: model.images[n].projection_center() for n in numbers}
    focal = {n: model.images[n].camera.mean_focal_length() for n in numbers}
    contradicting: set[Pair] = set()
    for a in numbers:
        seen = np.flatnonzero(sees[a][:-1])
        if len(seen) < MIN_POINTS:
            continue
        direction, distance = _rays(center[a], xyz[seen])
        for b in numbers:
            pair = (min(a, b), max(a, b))
            if a == b or pair in contradicting:
                continue
            other_direction, other_distance = _rays(center[b], xyz[seen])
            near = (direction * other_direction).sum(axis=1) > np.cos(np.radians(MAX_ANGLE))
            # Compared without division: a point may lie in a camera's center.
            here, there = distance * focal[b], other_distance * focal[a]
            should = seen[near & (here < MAX_ZOOM * there) & (there < MAX_ZOOM * here)]
            should = should[_inside(model.images[b], xyz[should], usable.get(b))]
            if len(should) < MIN_POINTS:
                continue
            shared = sees[b].copy()
            if pair in matches:
                shared[point_of[a][matches[pair][:, 0 if a < b else 1]]] = True
            both = should[shared[should]]
            few = MIN_SHARED_POINTS <= len(both) < MIN_SHARED_FRACTION * len(should)
            if few and _spread(xyz[both]) < MAX_SPREAD_FRACTION * _spread(xyz[should]):
                contradicting.add(pair)
    return contradicting


def _spread(xyz: Float64) -> float:
    """The area of points [P, 3]: the product of their two largest standard deviations."""
    variances = np.linalg.eigvalsh(np.cov(xyz.T))
    return float(np.sqrt(max(variances[1], 0.0) * variances[2]))


def _rays(center: Float64, xyz: Float64) -> tuple[Float64, Float64]:
    """Unit directions from points [P, 3] to a camera's center, and their distances [P]."""
    offset = center - xyz
    distance: Float64 = np.linalg.norm(offset, axis=1)
    directions: Float64 = offset / np.maximum(distance, 1e-12)[:, None]
    return directions, distance


def _inside(image: Any, xyz: Float64, usable: Bool | None) -> Bool:
    """Which points [P, 3] project into a photo, off its border and on usable pixels."""
    pose = image.cam_from_world().matrix()
    local = xyz @ pose[:, :3].T + pose[:, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    camera = image.camera
    u = camera.focal_length_x * local[:, 0] / depth + camera.principal_point_x
    v = camera.focal_length_y * local[:, 1] / depth + camera.principal_point_y
    inside: Bool = (
        (local[:, 2] > 1e-9)
        & (np.minimum(u, v) > BORDER_PX)
        & (u < camera.width - BORDER_PX)
        & (v < camera.height - BORDER_PX)
    )
    if usable is not None:
        column, row = (np.where(inside, at, 0.0).astype(np.int64) for at in (u, v))
        inside &= usable[row, column]
    return inside


def parts(
    strengths: Mapping[Pair, int], contradicted: Collection[Pair], apart: Collection[Pair] = ()
) -> dict[int, int]:
    """Divide photos into parts, strongest links first.

    A link that would put a contradicted pair into one part is ignored, unless it is nearly as
    strong as the strongest links of these photos.

    Args:
        strengths: number of matches of each pair of photos.
        contradicted: pairs that should not be in one part.
        apart: pairs that are not in one part, however strong the link.

    Returns:
        For each photo the smallest number in its part.
    """
    strongest: dict[int, int] = {}
    for pair, strength in strengths.items():
        for photo in pair:
            strongest[photo] = max(strongest.get(photo, 0), strength)
    part = {photo: {photo} for photo in strongest}
    for (a, b), strength in sorted(strengths.items(), key=lambda link: (-link[1], link[0])):
        first, second = part[a], part[b]
        if (
            first is second
            or any(
                strength < MIN_LINK_FRACTION * min(strongest.get(x, 0), strongest.get(y, 0))
                for x, y in contradicted
                if (x in first and y in second) or (x in second and y in first)
            )
            or any((x in first and y in second) or (x in second and y in first) for x, y in apart)
        ):
            continue
        first |= second
        part.update(dict.fromkeys(second, first))
    return {photo: min(members) for photo, members in part.items()}


def links_between_parts(
    strengths: Mapping[Pair, int], contradicted: Collection[Pair], apart: Collection[Pair] = ()
) -> set[Pair]:
    """The pairs of photos in different ``parts``, whose matches are left out."""
    if not contradicted and not apart:
        return set()
    part = parts(strengths, contradicted, apart)
    return {(a, b) for a, b in strengths if part[a] != part[b]}
