"""Use a network's prediction to find matches, and to leave out wrong ones.

Roughly known cameras leave a band around the epipolar lines in which features are compared, so that
fewer wrong ones compete with the right one.
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
from igsr.cameras.colmap.database import image_id
from igsr.cameras.colmap.guided_matching import (
    EpipolarLine,
    Features,
    comparable,
    guided_matches,
)
from igsr.cameras.colmap.matcher import MIN_MATCHES
from igsr.cameras.depth_maps import AlignedPhoto
from igsr.cameras.estimate import Progress
from igsr.cameras.grid import ray_slopes
from igsr.capture import Camera

#: Half the width of the band, as a fraction of the longer side: about two degrees.
BAND = 0.03
#: Minimum fraction of a photo's points that another shows for the two to overlap.
MIN_OVERLAP = 0.1
#: Number of points for that test.
OVERLAP_POINTS = 500
#: Maximum relative difference of depths on one surface.
MAX_DEPTH_DIFFERENCE = 0.3
#: Minimum number of matches in the band; repeated patterns give a few by chance.
MIN_BAND_MATCHES = 30
#: Maximum median error of a pair's matches, which all share if a camera has a wrong rotation, as a
#: fraction of the longer side.
MAX_SHARED_ERROR = 0.08
#: Maximum error of a match beyond that, as a fraction of the longer side.
MAX_OWN_ERROR = 0.05
#: Minimum fraction of a pair's matches that must agree with the prediction to be kept.
MIN_AGREEING = 0.5


def overlapping(photos: Sequence[AlignedPhoto | None]) -> list[tuple[int, int]]:
    """Indices of pairs of predicted photos in one world that show parts of each other."""
    points: dict[int, npt.NDArray[np.float64]] = {}
    for i, photo in enumerate(photos):
        if photo is not None:
            xyz, _ = photo.world_points()
            points[i] = xyz[:: max(1, len(xyz) // OVERLAP_POINTS)]
    return [
        (a, b)
        for a, b in combinations(points, 2)
        if max(_shown(points[a], photos[b]), _shown(points[b], photos[a])) >= MIN_OVERLAP
    ]


def _shown(xyz: npt.NDArray[np.float64], photo: AlignedPhoto | None) -> float:
    """The fraction of points [M, 3] that a photo shows."""
    if photo is None or not len(xyz):
        return 0.0
    shown, z, surface, _ = photo.shown_at(xyz)
    with np.errstate(invalid="ignore"):
        return float(np.mean(shown & (np.abs(z - surface) < MAX_DEPTH_DIFFERENCE * z)))


def matched_by_prediction(
    matches: Path, photos: Sequence[AlignedPhoto | None], seed: int, show: Progress
) -> Path:
    """Copy a database, and match overlapping pairs without matches along the predicted lines.

    Args:
        matches: database with SIFT features.
        photos: predicted, in one world; depths that are not confident are NaN.
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
            ids = image_id(a), image_id(b)
            if opened.exists_two_view_geometry(*ids):
                if len(opened.read_two_view_geometry(*ids).inlier_matches) >= MIN_MATCHES:
                    continue
                opened.delete_two_view_geometry(*ids)
            for i in {a, b} - features.keys():
                features[i] = comparable(
                    opened.read_keypoints(image_id(i))[:, :2],
                    opened.read_descriptors(image_id(i)).data,
                )
            one, other = cameras[a], cameras[b]
            band = BAND * max(one.width, one.height, other.width, other.height)
            line = EpipolarLine(_fundamental_matrix(one, other), band)
            found = guided_matches(features[a], features[b], line)
            if len(found) < MIN_BAND_MATCHES:
                continue
            geometry = pycolmap.estimate_two_view_geometry(
                _pinhole(one),
                features[a].xy.astype(np.float64),
                _pinhole(other),
                features[b].xy.astype(np.float64),
                found,
                options,
            )
            if len(geometry.inlier_matches) >= MIN_BAND_MATCHES:
                opened.write_two_view_geometry(*ids, geometry)
    show("matching", len(pairs), len(pairs))
    return database


def without_contradictions(matches: Path, photos: Sequence[AlignedPhoto | None]) -> Path:
    """Copy a database without the matches that contradict a network's prediction.

    Matches between similar sides of an object may agree with some geometry of their pair. If fewer
    than half of a pair's matches agree with the prediction, all are left out.

    Args:
        matches: database.
        photos: as for ``matched_by_prediction``.
    """
    pycolmap = load_pycolmap()
    database = matches.with_name("agreeing.db")
    shutil.copyfile(matches, database)
    with pycolmap.Database.open(database) as opened:
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            ids = pycolmap.pair_id_to_image_pair(pair)
            one, other = (photos[number - image_id(0)] for number in ids)
            inliers = geometry.inlier_matches
            if one is None or other is None or not len(inliers):
                continue
            places = [
                opened.read_keypoints(number)[inliers[:, side], :2]
                for side, number in enumerate(ids)
            ]
            # The depths of one of the two photos may be wrong.
            agrees = max(
                _agrees(one, other, places[0], places[1]),
                _agrees(other, one, places[1], places[0]),
                key=np.count_nonzero,
            )
            if agrees.all():
                continue
            if np.count_nonzero(agrees) >= max(MIN_MATCHES, MIN_AGREEING * len(inliers)):
                geometry.inlier_matches = inliers[agrees]
                opened.update_two_view_geometry(*ids, geometry)
            else:
                opened.delete_two_view_geometry(*ids)
    return database


def _agrees(
    one: AlignedPhoto,
    other: AlignedPhoto,
    places: npt.NDArray[np.float32],
    other_places: npt.NDArray[np.float32],
) -> npt.NDArray[np.bool_]:
    """Which matches [M] agree with the prediction; all do if too few depths are known.

    A wrong rotation of a camera shifts all matches alike; matches between similar sides have
    different errors.
    """
    errors = _errors(one, other, places, other_places)
    known = ~np.isnan(errors[:, 0])
    if np.count_nonzero(known) < MIN_MATCHES:
        return np.ones(len(errors), dtype=bool)
    shift = np.median(errors[known], axis=0)
    if not np.linalg.norm(shift) <= MAX_SHARED_ERROR:
        return np.zeros(len(errors), dtype=bool)
    return np.asarray(~known | (np.linalg.norm(errors - shift, axis=1) <= MAX_OWN_ERROR))


def _errors(
    one: AlignedPhoto,
    other: AlignedPhoto,
    places: npt.NDArray[np.float32],
    other_places: npt.NDArray[np.float32],
) -> npt.NDArray[np.float64]:
    """Errors of the predicted places in the other photo [M, 2], in units of its longer side.

    Infinite for places behind the other camera, NaN for unknown depths.
    """
    slopes = ray_slopes(places, one.camera.K)
    local = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0)
    local *= one.depths_at(places.astype(np.float64))[:, None]
    viewmat, K = one.camera.viewmat, other.camera.K
    seen = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    seen = seen @ other.camera.viewmat[:3, :3].T + other.camera.viewmat[:3, 3]
    with np.errstate(all="ignore"):
        pixels = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[[0, 1], 2]
    errors = (pixels - other_places) / max(other.camera.width, other.camera.height)
    errors[seen[:, 2] <= 0.0] = np.inf
    return np.asarray(errors)


def _fundamental_matrix(one: Camera, other: Camera) -> npt.NDArray[np.float64]:
    relative = other.viewmat @ np.linalg.inv(one.viewmat)
    x, y, z = relative[:3, 3]
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ relative[:3, :3]
    fundamental: npt.NDArray[np.float64] = (
        np.linalg.inv(other.K).T @ essential @ np.linalg.inv(one.K)
    )
    return fundamental


def _pinhole(camera: Camera) -> Any:
    pycolmap = load_pycolmap()
    K = camera.K
    return pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    )
