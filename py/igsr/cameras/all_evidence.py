"""Combine a network's prediction with features.

If COLMAP places all photos, its cameras are kept: no network is as accurate. Else the network's
cameras are the start: features are also matched along the epipolar lines that it predicts, and
bundle adjustment with the prediction as a prior weighs both for each photo.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.name_lists import listed
from igsr.cameras.colmap.adjustment import (
    MIN_POINTS,
    Adjusted,
    adjusted,
    deviations,
    evidence_of_model,
)
from igsr.cameras.colmap.attempts import FIRST_DOUBTFUL, THRESHOLDS, Mapped, mapped
from igsr.cameras.colmap.estimator import guarded, matched_photos, usable_by_image_id
from igsr.cameras.colmap.mapping import without_distortion
from igsr.cameras.colmap.matchers import Matchers
from igsr.cameras.colmap.matching import matched_along_lines, with_matches
from igsr.cameras.colmap.predicted_matches import matched_by_prediction, without_contradictions
from igsr.cameras.colmap.result import estimate_of
from igsr.cameras.depth_maps import AlignedPhoto
from igsr.cameras.estimate import Progress
from igsr.cameras.prior_adjustment import Spread, spread_of
from igsr.capture import Camera, Points
from igsr.capture.photo_folder import Photo
from igsr.capture.types import PoseEvidence, Tracks
from igsr.capture.undistort import Lens
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import similarity_between

Float64 = npt.NDArray[np.float64]

#: COLMAP is kept over a contradicting prediction if it places more than this fraction of photos.
MIN_PLACED_FRACTION = 0.5
#: Maximum mean angle between COLMAP's or adjusted cameras and the predicted ones, degrees.
MAX_ANGLE = 15.0
#: Maximum factor between adjusted and predicted focal lengths.
MAX_FOCAL_FACTOR = 1.5
#: Minimum number of photos that COLMAP must place to be used.
MIN_PLACED = 3
#: Default standard deviations of predicted cameras: degrees, and units of the median depth.
ROTATION_DEVIATION = 1.5
CENTER_DEVIATION = 0.03
#: Bounds of measured standard deviations, as factors of the default.
MIN_DEVIATION_FACTOR = 0.1
MAX_DEVIATION_FACTOR = 6.0
#: A camera rests on features alone if they leave less than this fraction of the default.
FEATURES_ALONE = 0.5


@dataclass(frozen=True, eq=False)
class Evidence:
    """Cameras and depths by all evidence, in one world; None for photos that are not placed."""

    cameras: list[Camera | None]
    photos: list[AlignedPhoto | None]  # with depths; also None if these are unknown
    lenses: list[Lens | None]  # as ``Estimate``
    points: Points | None  # of features, with tracks
    evidence: list[PoseEvidence | None]
    warnings: list[str]  # for the user


def with_all_evidence(
    photos: Sequence[Photo],
    predicted: Sequence[AlignedPhoto | None],
    confident: Sequence[npt.NDArray[np.bool_] | None],
    network: str,
    matchers: Matchers,
    seed: int,
    progress: Progress | None = None,
) -> Evidence:
    """Find cameras by features and a network's prediction together.

    Args:
        photos: at least two.
        predicted: per photo, in one world, or None. Photos of one camera have one focal length,
            the same in both directions.
        confident: bool [h, w] per photo: depths of which the network is confident.
        network: its name, for messages.
        matchers: of features.
        seed: random seed.
        progress: as for estimators.

    Raises:
        IgsrError: COLMAP fails.
    """
    show = progress or (lambda stage, done, total: None)
    with tempfile.TemporaryDirectory(prefix="igsr-colmap-") as folder, guarded(seed):
        matches = matched_photos(photos, Path(folder), matchers, seed, show)
        # Not COLMAP's lowest thresholds: the prediction is more reliable.
        found = mapped(
            len(photos),
            matches,
            seed,
            show,
            sift=matchers.sift,
            aliked=matchers.aliked,
            usable=usable_by_image_id(photos),
            attempts=THRESHOLDS[:FIRST_DOUBTFUL],
        )
        model = found.model
        if model is not None:
            few = model.num_reg_images() < MIN_PLACED
            found = replace(found, model=None if few else without_distortion(model))
        placed = estimate_of(photos, found).cameras
        if all(placed):
            return _by_features(photos, predicted, found)
        world, warnings = _in_one_world(predicted, placed), []
        if world is None:
            count = sum(camera is not None for camera in placed)
            contradiction = (
                f"Features place {count} of {len(photos)} photos, but not where {network} "
                "predicts them"
            )
            if count > MIN_PLACED_FRACTION * len(photos):
                by_features = _by_features(photos, predicted, found)
                by_features.warnings.append(f"{contradiction}; the prediction is not used")
                return by_features
            # Wrong matches between similar sides of an object usually place few photos.
            found, placed = replace(found, model=None), [None] * len(photos)
            world = list(predicted)
            warnings.append(f"{contradiction}; these features are not used")
        result = _adjusted(
            photos, world, confident, found, placed, matches, matchers.sift, seed, show
        )
    both = _by_both(photos, world, found, result, network)
    return replace(both, warnings=[*warnings, *both.warnings])


def _by_features(
    photos: Sequence[Photo], predicted: Sequence[AlignedPhoto | None], found: Mapped
) -> Evidence:
    """COLMAP's cameras, with the predicted depths scaled to its points."""
    placed = estimate_of(photos, found)
    known = evidence_of_model(photos, placed.cameras, found.model)
    depths = _with_cameras(photos, predicted, placed.cameras, placed.points)
    evidence = [known.get(i) for i in range(len(photos))]
    return Evidence(placed.cameras, depths, placed.lenses, placed.points, evidence, placed.warnings)


def _in_one_world(
    predicted: Sequence[AlignedPhoto | None], placed: Sequence[Camera | None]
) -> list[AlignedPhoto | None] | None:
    """Map the prediction to the world of COLMAP's cameras; None if they contradict it."""
    pairs = [
        (one.camera, camera)
        for one, camera in zip(predicted, placed, strict=True)
        if one is not None and camera is not None
    ]
    if not any(placed):
        return list(predicted)
    if len(pairs) < 2:
        return None
    before, after = (list(side) for side in zip(*pairs, strict=True))
    if pose_errors(before, after)["rotation"] > MAX_ANGLE:
        return None
    similarity = similarity_between(before, after)
    return [None if one is None else one.mapped(similarity) for one in predicted]


def _adjusted(
    photos: Sequence[Photo],
    world: Sequence[AlignedPhoto | None],
    confident: Sequence[npt.NDArray[np.bool_] | None],
    found: Mapped,
    placed: Sequence[Camera | None],
    matches: Path,
    sift: bool,
    seed: int,
    show: Progress,
) -> Adjusted | None:
    """Adjust the cameras to all matches; None if photos share too few features."""
    reliable = [
        None
        if one is None or mask is None
        else replace(one, depth=np.where(mask, one.depth, np.float32(np.nan)))
        for one, mask in zip(world, confident, strict=True)
    ]
    predicted = {i: one.camera for i, one in enumerate(world) if one is not None}
    if sift:
        matches = matched_by_prediction(matches, reliable, seed, show)
        matches = matched_along_lines(matches, set(predicted), show) or matches
    matches = without_contradictions(matches, reliable)
    starts = predicted | {i: one for i, one in enumerate(placed) if one is not None}
    if len(with_matches(matches) & starts.keys()) < 2:
        return None
    lenses: dict[int, Sequence[float]] = {}
    if found.model is not None:
        for image in found.model.reg_image_ids():
            camera = found.model.images[image].camera
            lenses[camera.camera_id] = camera.params
    return adjusted(photos, starts, reliable, default_spread(world), matches, lenses, seed, show)


def _by_both(
    photos: Sequence[Photo],
    world: Sequence[AlignedPhoto | None],
    found: Mapped,
    result: Adjusted | None,
    network: str,
) -> Evidence:
    """Choose the camera of each photo, and state what it rests on."""
    predicted = [None if one is None else one.camera for one in world]
    default = default_spread(world)
    warnings = []
    if result is not None and _contradicts(predicted, result):
        warnings.append(
            f"Bundle adjustment contradicts the prediction of {network}, and is not used"
        )
        result = None
    by_colmap = estimate_of(photos, found if result is None else replace(found, model=result.model))
    if result is None:
        by_features = by_colmap.cameras
        known = evidence_of_model(photos, by_features, found.model)
    else:
        by_features = [result.cameras.get(i) for i in range(len(photos))]
        known = {
            i: _evidence(covariance, default)
            for i, covariance in result.covariances.items()
            if result.observed[i] >= MIN_POINTS
        }
    pairs = list(zip(predicted, by_features, strict=True))
    certain = [
        (before, after)
        for i, (before, after) in enumerate(pairs)
        if before is not None and after is not None and i in known
        if known[i].rests_on == "features"
    ]
    of_prediction = _evidence_of_prediction(certain, default)
    cameras: list[Camera | None] = []
    for i, (before, after) in enumerate(pairs):
        cameras.append(after if i in known else before)
        if i not in known and before is not None:
            known[i] = of_prediction
    evidence = [known.get(i) for i in range(len(photos))]
    with_features = {photos[i].name for i, one in known.items() if one.rests_on != "network"}
    points = _with_tracks_of(by_colmap.points, with_features)
    lenses = [
        lens if photo.name in with_features else None
        for photo, lens in zip(photos, by_colmap.lenses or [None] * len(photos), strict=True)
    ]
    if found.removed_pairs:
        warnings.append(
            "Some photos show places that look alike: their matches contradict others and "
            f"were left out (pairs of photos: {found.removed_pairs})."
        )
    alone = [
        photo.name
        for photo, one in zip(photos, evidence, strict=True)
        if one is not None and one.rests_on == "network"
    ]
    if alone:
        which = "all photos" if len(alone) == len(known) else listed(alone)
        warnings.append(
            f"Cameras of {which} are as {network} predicts them, with errors of about "
            f"{of_prediction.rotation:.1f} degrees per axis: they share too few features with "
            "other photos"
        )
    depths = _with_cameras(photos, world, cameras, points)
    return Evidence(cameras, depths, lenses, points, evidence, warnings)


def _contradicts(predicted: Sequence[Camera | None], result: Adjusted) -> bool:
    """Whether adjusted cameras are so far from the predicted ones that they must be wrong."""
    pairs = [
        (camera, wanted)
        for i, camera in result.cameras.items()
        if (wanted := predicted[i]) is not None and result.observed[i] >= MIN_POINTS
    ]
    if len(pairs) < 2:
        return False
    after, before = (list(side) for side in zip(*pairs, strict=True))
    factors = [a.K[0, 0] / b.K[0, 0] for a, b in pairs]
    angle = pose_errors(after, before)["rotation"]
    return angle > MAX_ANGLE or max(max(f, 1.0 / f) for f in factors) > MAX_FOCAL_FACTOR


def default_spread(world: Sequence[AlignedPhoto | None]) -> Spread:
    """The default spread of predicted cameras, in units of their world."""
    depths = [float(np.nanmedian(one.depth)) for one in world if one is not None]
    unit = float(np.median(depths or [1.0]))
    return Spread(float(np.radians(ROTATION_DEVIATION)), CENTER_DEVIATION * unit)


def _evidence(covariance: Float64, default: Spread) -> PoseEvidence:
    """Evidence of a camera with enough points."""
    turn, move = deviations(covariance)
    alone = turn < FEATURES_ALONE * default.rotation and move < FEATURES_ALONE * default.center
    return PoseEvidence("features" if alone else "both", float(np.degrees(turn)), move)


def _evidence_of_prediction(
    pairs: Sequence[tuple[Camera, Camera]], default: Spread
) -> PoseEvidence:
    """Evidence of a predicted camera, by the errors of other predictions.

    Args:
        pairs: predicted cameras, and the same by features.
        default: spread if there are too few pairs.
    """
    spread = default
    if len(pairs) >= MIN_PLACED:
        before, after = (list(side) for side in zip(*pairs, strict=True))
        turn, move = spread_of(before, after)
        low, high = MIN_DEVIATION_FACTOR, MAX_DEVIATION_FACTOR
        spread = Spread(
            float(np.clip(turn, low * default.rotation, high * default.rotation)),
            float(np.clip(move, low * default.center, high * default.center)),
        )
    return PoseEvidence("network", float(np.degrees(spread.rotation)), spread.center)


def _with_tracks_of(points: Points | None, names: set[str]) -> Points | None:
    """Points with only the tracks of some photos."""
    if points is None or points.tracks is None:
        return points
    tracks = points.tracks
    kept = np.isin(tracks.view, [k for k, name in enumerate(tracks.names) if name in names])
    return replace(
        points, tracks=Tracks(tracks.names, tracks.view[kept], tracks.point[kept], tracks.xy[kept])
    )


def _with_cameras(
    photos: Sequence[Photo],
    predicted: Sequence[AlignedPhoto | None],
    cameras: Sequence[Camera | None],
    points: Points | None,
) -> list[AlignedPhoto | None]:
    """The predicted depths with other cameras, scaled to the points that each photo sees."""
    result: list[AlignedPhoto | None] = []
    tracks = None if points is None else points.tracks
    for photo, one, camera in zip(photos, predicted, cameras, strict=True):
        if one is None or camera is None:
            result.append(None)
            continue
        if points is not None and tracks is not None and photo.name in tracks.names:
            own = tracks.view == tracks.names.index(photo.name)
            xyz = points.xyz[tracks.point[own]]
            depths = xyz @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
            known = one.depths_at(tracks.xy[own])
            both = np.isfinite(known) & (depths > 0.0)
            if np.count_nonzero(both) >= MIN_POINTS:
                # The median is robust against wrong points and edges.
                ratio = np.exp(np.median(np.log(depths[both] / known[both])))
                one = replace(one, depth=(one.depth * ratio).astype(np.float32))
        result.append(replace(one, camera=camera))
    return result
