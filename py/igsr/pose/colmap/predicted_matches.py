"""Matches of photos that agree with what a network predicts.

Of all features of two photos, those of other places drown the few right ones. Where roughly known
cameras leave a band to look in, fewer compete.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.colmap.database import image_id
from igsr.pose.colmap.epipolar import EpipolarLine
from igsr.pose.colmap.given_matches import FEWEST
from igsr.pose.colmap.guided_matching import Features, comparable, guided_matches
from igsr.pose.estimate import Progress

#: Half of the band's width, as a part of the photo's longer side: about two degrees.
BAND = 0.03
#: Part of a photo's points, at least, that another must show for the two to overlap; points asked.
OVERLAP, ASKED = 0.1, 500
#: Part of the longer side that a match may be from where the prediction has it, in the median.
SAME_PLACE = 0.1
#: Part that depths may differ by where two photos show one surface.
SAME_SURFACE = 0.3


def overlapping(photos: Sequence[AlignedPhoto | None]) -> list[tuple[int, int]]:
    """Pairs of photos, by index, of which at least one shows a part of what the other shows.

    Args:
        photos: as a network predicts them, in one world; None where nothing is predicted.
    """
    points: dict[int, npt.NDArray[np.float64]] = {}
    for i, photo in enumerate(photos):
        if photo is not None:
            xyz, _ = photo.world_points()
            points[i] = xyz[:: max(1, len(xyz) // ASKED)]
    return [
        (a, b)
        for a, b in combinations(points, 2)
        if max(_shown(points[a], photos[b]), _shown(points[b], photos[a])) >= OVERLAP
    ]


def _shown(xyz: npt.NDArray[np.float64], photo: AlignedPhoto | None) -> float:
    """The part of points [M, 3] that a photo shows."""
    if photo is None or not len(xyz):
        return 0.0
    shown, z, surface, _ = photo.shown_at(xyz)
    with np.errstate(invalid="ignore"):
        return float(np.mean(shown & (np.abs(z - surface) < SAME_SURFACE * z)))


def matched_by_prediction(
    matches: Path,
    photos: Sequence[AlignedPhoto | None],
    sift: bool,
    seed: int,
    show: Progress,
) -> Path:
    """A copy of a database, with the matches that agree with what a network predicts.

    Pairs whose matches contradict it lose them: sides of an object that look alike match, and
    nothing else tells them apart. Pairs that have none and overlap are matched along the lines.

    Args:
        matches: the database of the photos.
        photos: as a network predicts them, in one world; depths that it is not sure of are NaN.
        sift: whether features are SIFT's: of others, none are matched.
        seed: of the verification.
        show: called with "matching", pairs done and all pairs.
    """
    import pycolmap

    database = matches.with_name("predicted.db")
    shutil.copyfile(matches, database)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    known = {i: photo for i, photo in enumerate(photos) if photo is not None}
    pairs = list(combinations(known, 2))
    wanted = set(overlapping(photos)) if sift else set()
    features: dict[int, Features] = {}
    with pycolmap.Database.open(database) as opened:
        for done, (a, b) in enumerate(pairs):
            show("matching", done, len(pairs))
            first, second = image_id(a), image_id(b)
            places = [opened.read_keypoints(number)[:, :2] for number in (first, second)]
            if opened.exists_two_view_geometry(first, second):
                found = opened.read_two_view_geometry(first, second).inlier_matches
                if len(found) >= FEWEST and _agrees(known[a], known[b], *places, found):
                    continue
                opened.delete_two_view_geometry(first, second)
            if (a, b) not in wanted:
                continue
            for i, xy in zip((a, b), places, strict=True):
                if i not in features:
                    features[i] = comparable(xy, opened.read_descriptors(image_id(i)).data)
            one, other = known[a].camera, known[b].camera
            band = BAND * max(one.width, one.height, other.width, other.height)
            found = guided_matches(features[a], features[b], EpipolarLine(_lines(one, other), band))
            if len(found) < FEWEST:
                continue
            geometry = pycolmap.estimate_two_view_geometry(
                _camera(one),
                places[0].astype(np.float64),
                _camera(other),
                places[1].astype(np.float64),
                found,
                options,
            )
            found = geometry.inlier_matches
            if len(found) >= FEWEST and _agrees(known[a], known[b], *places, found):
                opened.write_two_view_geometry(first, second, geometry)
    show("matching", len(pairs), len(pairs))
    return database


def _agrees(
    one: AlignedPhoto,
    other: AlignedPhoto,
    places: npt.NDArray[np.float32],
    other_places: npt.NDArray[np.float32],
    matches: npt.NDArray[np.uint32],
) -> bool:
    """Whether most matches are where the other photo shows the same place, as it is predicted."""
    ways = (
        (one, other, places[matches[:, 0]], other_places[matches[:, 1]]),
        (other, one, other_places[matches[:, 1]], places[matches[:, 0]]),
    )
    off = np.concatenate([_off(*way) for way in ways])
    return not len(off) or bool(np.median(off) <= SAME_PLACE)


def _off(
    one: AlignedPhoto,
    other: AlignedPhoto,
    places: npt.NDArray[np.float32],
    other_places: npt.NDArray[np.float32],
) -> npt.NDArray[np.float64]:
    """How far matches are from where the other photo shows the place, as parts of its longer side.

    Infinite where the place is behind the other camera; without those of unknown depth.
    """
    depth = one.depths_at(places.astype(np.float64))
    known = np.isfinite(depth)
    K, viewmat = one.camera.K, one.camera.viewmat
    slopes = (places[known] - K[[0, 1], 2]) / K[[0, 1], [0, 1]]
    local = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0) * depth[known, None]
    xyz = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    K, viewmat = other.camera.K, other.camera.viewmat
    seen = xyz @ viewmat[:3, :3].T + viewmat[:3, 3]
    ahead = seen[:, 2] > 0.0
    with np.errstate(all="ignore"):
        pixels = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[[0, 1], 2]
        off = np.linalg.norm(pixels - other_places[known], axis=1)
    return np.where(ahead, off / max(other.camera.width, other.camera.height), np.inf)


def _lines(one: Camera, other: Camera) -> npt.NDArray[np.float64]:
    """The fundamental matrix from one photo to another."""
    relative = other.viewmat @ np.linalg.inv(one.viewmat)
    x, y, z = relative[:3, 3]
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ relative[:3, :3]
    fundamental: npt.NDArray[np.float64] = (
        np.linalg.inv(other.K).T @ essential @ np.linalg.inv(one.K)
    )
    return fundamental


def _camera(camera: Camera) -> Any:
    import pycolmap

    K = camera.K
    return pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )
