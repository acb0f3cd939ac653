"""Matches between photos that a network says overlap, along the lines that it predicts.

Of all features of two photos, those of other places drown the few right ones. Where roughly known
cameras leave a band to look in, fewer compete.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
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


def matched_along_predicted_lines(
    matches: Path,
    cameras: Mapping[int, Camera],
    pairs: Sequence[tuple[int, int]],
    seed: int,
    show: Progress,
) -> Path:
    """A copy of a database, with matches of pairs that have none yet.

    Args:
        matches: the database, with SIFT features.
        cameras: roughly right, by the index of the photo.
        pairs: that are looked at, the smaller index first.
        seed: of the verification.
        show: called with "matching", pairs done and all pairs.
    """
    import pycolmap

    database = matches.with_name("predicted.db")
    shutil.copyfile(matches, database)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    features: dict[int, Features] = {}
    with pycolmap.Database.open(database) as opened:
        for done, (a, b) in enumerate(pairs):
            show("matching", done, len(pairs))
            first, second = image_id(a), image_id(b)
            known = opened.exists_two_view_geometry(first, second)
            if known and len(opened.read_two_view_geometry(first, second).inlier_matches) >= FEWEST:
                continue
            for i in {a, b} - features.keys():
                features[i] = comparable(
                    opened.read_keypoints(image_id(i))[:, :2],
                    opened.read_descriptors(image_id(i)).data,
                )
            one, other = cameras[a], cameras[b]
            band = BAND * max(one.width, one.height, other.width, other.height)
            found = guided_matches(features[a], features[b], EpipolarLine(_lines(one, other), band))
            if len(found) < FEWEST:
                continue
            geometry = pycolmap.estimate_two_view_geometry(
                _camera(one),
                features[a].xy.astype(np.float64),
                _camera(other),
                features[b].xy.astype(np.float64),
                found,
                options,
            )
            if len(geometry.inlier_matches) < FEWEST:
                continue
            if known:
                opened.update_two_view_geometry(first, second, geometry)
            else:
                opened.write_two_view_geometry(first, second, geometry)
    show("matching", len(pairs), len(pairs))
    return database


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
