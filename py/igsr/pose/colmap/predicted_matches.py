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

from igsr._internal.load_pycolmap import load_pycolmap
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
#: Matches in the band, at least: of repeated patterns some fit to some geometry by chance.
FEWEST_IN_BAND = 30
#: Parts of the longer side that matches may be from where the prediction has them: all together, as
#: cameras that are turned wrongly have them, in the median; and each by itself.
TOGETHER, ALONE = 0.08, 0.05
#: Part of a pair's matches that must agree with the prediction for these to be kept.
LEAST_LEFT = 0.5
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
    seed: int,
    show: Progress,
) -> Path:
    """A copy of a database, with matches of pairs that have none, along the predicted lines.

    Args:
        matches: the database of the photos, with SIFT features.
        photos: as a network predicts them, in one world; depths that it is not sure of are NaN.
        seed: of the verification.
        show: called with "matching", pairs done and all pairs.
    """
    pycolmap = load_pycolmap()
    database = matches.with_name("predicted.db")
    shutil.copyfile(matches, database)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    cameras = {i: photo.camera for i, photo in enumerate(photos) if photo is not None}
    pairs = overlapping(photos)
    features: dict[int, Features] = {}
    with pycolmap.Database.open(database) as opened:
        for done, (a, b) in enumerate(pairs):
            show("matching", done, len(pairs))
            if opened.exists_two_view_geometry(image_id(a), image_id(b)):
                known = opened.read_two_view_geometry(image_id(a), image_id(b))
                if len(known.inlier_matches) >= FEWEST:
                    continue
                opened.delete_two_view_geometry(image_id(a), image_id(b))
            for i in {a, b} - features.keys():
                features[i] = comparable(
                    opened.read_keypoints(image_id(i))[:, :2],
                    opened.read_descriptors(image_id(i)).data,
                )
            one, other = cameras[a], cameras[b]
            band = BAND * max(one.width, one.height, other.width, other.height)
            found = guided_matches(features[a], features[b], EpipolarLine(_lines(one, other), band))
            if len(found) < FEWEST_IN_BAND:
                continue
            places = (features[i].xy.astype(np.float64) for i in (a, b))
            geometry = pycolmap.estimate_two_view_geometry(
                _camera(one), next(places), _camera(other), next(places), found, options
            )
            if len(geometry.inlier_matches) >= FEWEST_IN_BAND:
                opened.write_two_view_geometry(image_id(a), image_id(b), geometry)
    show("matching", len(pairs), len(pairs))
    return database


def without_contradictions(matches: Path, photos: Sequence[AlignedPhoto | None]) -> Path:
    """A copy of a database, without the matches that contradict what a network predicts.

    Sides of an object that look alike match, and agree with some geometry of their pair. A pair of
    which fewer than half of the matches are left has none.

    Args:
        matches: the database of the photos.
        photos: as for ``matched_by_prediction``.
    """
    pycolmap = load_pycolmap()
    database = matches.with_name("agreeing.db")
    shutil.copyfile(matches, database)
    with pycolmap.Database.open(database) as opened:
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            one, other = (photos[number - image_id(0)] for number in (first, second))
            found = geometry.inlier_matches
            if one is None or other is None or not len(found):
                continue
            places = [opened.read_keypoints(number)[:, :2] for number in (first, second)]
            ways = (
                (one, other, places[0][found[:, 0]], places[1][found[:, 1]]),
                (other, one, places[1][found[:, 1]], places[0][found[:, 0]]),
            )
            # The depths of one of the two photos may be wrong.
            agrees = max((_agrees(*way) for way in ways), key=np.count_nonzero)
            if agrees.all():
                continue
            if np.count_nonzero(agrees) >= max(FEWEST, LEAST_LEFT * len(found)):
                geometry.inlier_matches = found[agrees]
                opened.update_two_view_geometry(first, second, geometry)
            else:
                opened.delete_two_view_geometry(first, second)
    return database


def _agrees(
    one: AlignedPhoto,
    other: AlignedPhoto,
    places: npt.NDArray[np.float32],
    other_places: npt.NDArray[np.float32],
) -> npt.NDArray[np.bool_]:
    """Which matches [M] are where the other photo shows the same place, as it is predicted.

    A camera that is predicted with a wrong turn shifts all matches alike. Matches of a side that
    looks like another are off each by itself. What the network is not sure of agrees.
    """
    off = _off(one, other, places, other_places)
    known = ~np.isnan(off[:, 0])
    if np.count_nonzero(known) < FEWEST:
        return np.ones(len(off), dtype=bool)
    shift = np.median(off[known], axis=0)
    if not np.linalg.norm(shift) <= TOGETHER:
        return np.zeros(len(off), dtype=bool)
    return np.asarray(~known | (np.linalg.norm(off - shift, axis=1) <= ALONE))


def _off(
    one: AlignedPhoto,
    other: AlignedPhoto,
    places: npt.NDArray[np.float32],
    other_places: npt.NDArray[np.float32],
) -> npt.NDArray[np.float64]:
    """How far matches are from where the other photo shows the place [M, 2], in its longer sides.

    Infinite where the place is behind the other camera, NaN where its depth is unknown.
    """
    K, viewmat = one.camera.K, one.camera.viewmat
    slopes = (places - K[[0, 1], 2]) / K[[0, 1], [0, 1]]
    local = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0)
    local *= one.depths_at(places.astype(np.float64))[:, None]
    K = other.camera.K
    seen = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    seen = seen @ other.camera.viewmat[:3, :3].T + other.camera.viewmat[:3, 3]
    with np.errstate(all="ignore"):
        pixels = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[[0, 1], 2]
    off = (pixels - other_places) / max(other.camera.width, other.camera.height)
    off[seen[:, 2] <= 0.0] = np.inf
    return np.asarray(off)


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
    pycolmap = load_pycolmap()
    K = camera.K
    return pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )
