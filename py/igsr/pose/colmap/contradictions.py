"""Matches between places that only look alike, found by the matches that are missing.

A pattern that an object has twice, or two doors of one make, give matches that agree with the
geometry of a pair, and a model that places photos of one side among those of another. Such a model
contradicts itself: photos that it says see the same points from nearly the same direction share
few of them (Zach et al., "What Can Missing Correspondences Tell Us About 3D Structure and Motion?",
CVPR 2008), and those few lie in one place: the pattern. (Photos of other light or sharpness share
few too, but here and there.) Photos then are divided into parts without contradictions, strongest
links first, and the matches between the parts are left out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap

#: COLMAP's numbers of two photos, the smaller first.
Pair: TypeAlias = tuple[int, int]

#: Two photos must share points that both see within so many degrees, at a distance that differs by
#: less than this factor: SIFT finds a place again under such changes.
ANGLE, ZOOM = 25.0, 1.6
#: Part of these points that they share at least, where there are so many of them. In models without
#: mistakes no pair had less than 0.26; in one with photos misplaced, wrong pairs had 0.12 at most.
SHARED, FEWEST = 0.15, 100
#: What is shared, so many points at least, spreads over less than this part of the area of what
#: should be: it was 0.66 and more for right pairs, 0.41 and less for wrong ones.
SPREAD, FEWEST_SHARED = 0.5, 5
#: A contradiction does not divide photos that hang together by links of this part of the strongest
#: ones: there, something stands between the cameras.
STRONG = 0.25
#: Pixels from the border of a photo within which a point may be lost.
BORDER = 10.0


def links(database: Path) -> dict[Pair, npt.NDArray[np.uint32]]:
    """Matches [M, 2] of each pair of photos that has some, as indices of their features."""
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
    model: Any,
    matches: Mapping[Pair, npt.NDArray[np.uint32]],
    usable: Mapping[int, npt.NDArray[np.bool_]],
) -> set[Pair]:
    """Pairs of a model's photos that share few of the points that both should see.

    Args:
        model: pycolmap's reconstruction; photos of a rig are not looked at.
        matches: of pairs of photos, as ``links`` returns them.
        usable: pixels [H, W] that have features, by photo, where some have none.
    """
    numbers = sorted(model.reg_image_ids())
    rows = {point: row for row, point in enumerate(sorted(model.point3D_ids()))}
    if not rows or model.num_reg_frames() < len(numbers):
        return set()
    xyz = np.stack([model.points3D[point].xyz for point in rows])
    # The point of each feature, and which points each photo sees.
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
    centre = {n: model.images[n].projection_center() for n in numbers}
    focal = {n: model.images[n].camera.mean_focal_length() for n in numbers}
    found: set[Pair] = set()
    for a in numbers:
        seen = np.flatnonzero(sees[a][:-1])
        if len(seen) < FEWEST:
            continue
        away, distance = _rays(centre[a], xyz[seen])
        for b in numbers:
            pair = (min(a, b), max(a, b))
            if a == b or pair in found:
                continue
            other, other_distance = _rays(centre[b], xyz[seen])
            near = (away * other).sum(axis=1) > np.cos(np.radians(ANGLE))
            # Compared without division: a point may lie in a camera's centre.
            here, there = distance * focal[b], other_distance * focal[a]
            should = seen[near & (here < ZOOM * there) & (there < ZOOM * here)]
            should = should[_inside(model.images[b], xyz[should], usable.get(b))]
            if len(should) < FEWEST:
                continue
            shared = sees[b].copy()
            if pair in matches:
                shared[point_of[a][matches[pair][:, 0 if a < b else 1]]] = True
            both = should[shared[should]]
            if FEWEST_SHARED <= len(both) < SHARED * len(should) and _spread(
                xyz[both]
            ) < SPREAD * _spread(xyz[should]):
                found.add(pair)
    return found


def _spread(xyz: npt.NDArray[np.float64]) -> float:
    """The area that points [P, 3] spread over: the product of their two largest deviations."""
    variances = np.linalg.eigvalsh(np.cov(xyz.T))
    return float(np.sqrt(max(variances[1], 0.0) * variances[2]))


def _rays(
    centre: npt.NDArray[np.float64], xyz: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Unit directions from points [P, 3] to a camera's centre, and their distances [P]."""
    away = centre - xyz
    distance: npt.NDArray[np.float64] = np.linalg.norm(away, axis=1)
    directions: npt.NDArray[np.float64] = away / np.maximum(distance, 1e-12)[:, None]
    return directions, distance


def _inside(
    image: Any, xyz: npt.NDArray[np.float64], usable: npt.NDArray[np.bool_] | None
) -> npt.NDArray[np.bool_]:
    """Which points [P, 3] fall into a photo, off its border and where its pixels have features."""
    pose = image.cam_from_world().matrix()
    local = xyz @ pose[:, :3].T + pose[:, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    camera = image.camera
    u = camera.focal_length_x * local[:, 0] / depth + camera.principal_point_x
    v = camera.focal_length_y * local[:, 1] / depth + camera.principal_point_y
    inside: npt.NDArray[np.bool_] = (
        (local[:, 2] > 1e-9)
        & (np.minimum(u, v) > BORDER)
        & (u < camera.width - BORDER)
        & (v < camera.height - BORDER)
    )
    if usable is not None:
        column, row = (np.where(inside, at, 0.0).astype(np.int64) for at in (u, v))
        inside &= usable[row, column]
    return inside


def parts(strengths: Mapping[Pair, int], contradicted: Collection[Pair]) -> dict[int, int]:
    """The part that each linked photo is in, by the least number of its photos.

    The strongest links join first. One that would put a contradicted pair into one part joins
    nothing, unless it is about as strong as the strongest of these photos.

    Args:
        strengths: number of matches of each pair of photos.
        contradicted: pairs that must not be in one part.
    """
    strongest: dict[int, int] = {}
    for pair, strength in strengths.items():
        for photo in pair:
            strongest[photo] = max(strongest.get(photo, 0), strength)
    part = {photo: {photo} for photo in strongest}
    for (a, b), strength in sorted(strengths.items(), key=lambda one: (-one[1], one[0])):
        first, second = part[a], part[b]
        if first is second or any(
            strength < STRONG * min(strongest.get(x, 0), strongest.get(y, 0))
            for x, y in contradicted
            if (x in first and y in second) or (x in second and y in first)
        ):
            continue
        first |= second
        part.update(dict.fromkeys(second, first))
    return {photo: min(members) for photo, members in part.items()}


def links_between_parts(strengths: Mapping[Pair, int], contradicted: Collection[Pair]) -> set[Pair]:
    """The pairs of photos whose matches cannot all be right; see ``parts``."""
    if not contradicted:
        return set()
    part = parts(strengths, contradicted)
    return {(a, b) for a, b in strengths if part[a] != part[b]}
