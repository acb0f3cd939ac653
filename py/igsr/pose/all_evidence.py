"""One answer from what a network predicts and what features say.

Where COLMAP places all photos, its cameras stand: no network is as exact. Else the network's
cameras are the start. Features are matched along the lines that it predicts, too, and bundle
adjustment with the prediction as a prior decides, photo by photo, by how much each says.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, Points
from igsr.capture.photo_folder import Photo
from igsr.capture.types import PoseEvidence, Tracks
from igsr.capture.undistort import Lens
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import similarity_between
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.colmap.adjustment import (
    FEWEST_POINTS,
    Adjusted,
    adjusted,
    deviations,
    evidence_of_model,
)
from igsr.pose.colmap.attempts import Mapped, mapped
from igsr.pose.colmap.distortion import without_distortion
from igsr.pose.colmap.estimator import guarded, matched_photos, usable_by_number
from igsr.pose.colmap.evidence import DOUBTFUL, STEPS
from igsr.pose.colmap.matcher import Matcher
from igsr.pose.colmap.matching import matched_along_lines, with_matches
from igsr.pose.colmap.predicted_matches import matched_by_prediction, without_contradictions
from igsr.pose.colmap.result import estimate_of
from igsr.pose.estimate import Progress
from igsr.pose.name_lists import listed
from igsr.pose.prior_adjustment import Spread, spread_of

Float64 = npt.NDArray[np.float64]

#: COLMAP is right where the two contradict if it has placed more than this part of the photos.
MOST_RIGHT = 0.5
#: Degrees that cameras by features may be from the predicted ones, on average. Beyond, one of the
#: two is wrong.
FARTHEST = 15.0
#: Factor by which a focal length may change.
STRETCHED = 1.5
#: COLMAP's photos, at least, for their cameras to be a start.
FEWEST_PLACED = 3
#: Standard deviations of predicted cameras where nothing tells them: degrees, and units of the
#: median depth. What tells them is bounded by factors of these.
ROTATION, CENTRE, LEAST, MOST = 1.5, 0.03, 0.1, 6.0
#: A camera rests on features alone where they leave less than this part of the prediction's spread.
FEATURES_ALONE = 0.5


@dataclass(frozen=True, eq=False)
class Evidence:
    """What all evidence together says of photos, in one world.

    Attributes:
        cameras: per photo, or None where it has no place.
        photos: per photo with its camera and depths, or None where no depths are known.
        lenses: per photo, as ``Estimate``.
        points: of features, with tracks, or None.
        evidence: per photo what its camera rests on, or None where it has none.
        warnings: for the user.
    """

    cameras: list[Camera | None]
    photos: list[AlignedPhoto | None]
    lenses: list[Lens | None]
    points: Points | None
    evidence: list[PoseEvidence | None]
    warnings: list[str]


def with_all_evidence(
    photos: Sequence[Photo],
    predicted: Sequence[AlignedPhoto | None],
    sure: Sequence[npt.NDArray[np.bool_] | None],
    network: str,
    matcher: Matcher | None,
    seed: int,
    progress: Progress | None = None,
) -> Evidence:
    """Cameras of photos by features and prediction together.

    Args:
        photos: at least two.
        predicted: what a network says of each, in one world; None where it says nothing. Photos of
            one camera have one focal length, the same in both directions.
        sure: bool [h, w] per photo: depths that the network is sure of.
        network: its name, for messages.
        matcher: what finds and matches features, None for SIFT.
        seed: random seed.
        progress: as for estimators.

    Raises:
        IgsrError: COLMAP fails.
    """
    show = progress or (lambda stage, done, total: None)
    with tempfile.TemporaryDirectory(prefix="igsr-colmap-") as folder, guarded(seed):
        matches = matched_photos(photos, Path(folder), matcher, seed, show)
        sift = matcher is None
        # What COLMAP would need lower thresholds for, the network tells better.
        found = mapped(
            len(photos),
            matches,
            seed,
            show,
            sift=sift,
            usable=usable_by_number(photos),
            steps=STEPS[:DOUBTFUL],
        )
        model = found.model
        if model is not None:
            few = model.num_reg_images() < FEWEST_PLACED
            found = replace(found, model=None if few else without_distortion(model))
        placed = estimate_of(photos, found).cameras
        if all(placed):
            return _by_features(photos, predicted, found)
        world, warnings = _in_one_world(predicted, placed), []
        if world is None:
            count = sum(camera is not None for camera in placed)
            contradiction = (
                f"Features place {count} of {len(photos)} photos where {network} does not predict "
                "them"
            )
            if count > MOST_RIGHT * len(photos):
                left_out = _by_features(photos, predicted, found)
                left_out.warnings.append(f"{contradiction}; the prediction is left out")
                return left_out
            # Sides of an object that look alike are seldom more than a part of the photos.
            found, placed = replace(found, model=None), [None] * len(photos)
            world = list(predicted)
            warnings.append(f"{contradiction}; these features are left out")
        result = _adjusted(photos, world, sure, found, placed, matches, sift, seed, show)
    both = _by_both(photos, world, found, result, network)
    return replace(both, warnings=[*warnings, *both.warnings])


def _by_features(
    photos: Sequence[Photo], predicted: Sequence[AlignedPhoto | None], found: Mapped
) -> Evidence:
    """COLMAP's cameras, and depths that fit to its points."""
    placed = estimate_of(photos, found)
    told = evidence_of_model(photos, placed.cameras, found.model)
    depths = _with_cameras(photos, predicted, placed.cameras, placed.points)
    evidence = [told.get(i) for i in range(len(photos))]
    return Evidence(placed.cameras, depths, placed.lenses, placed.points, evidence, placed.warnings)


def _in_one_world(
    predicted: Sequence[AlignedPhoto | None], placed: Sequence[Camera | None]
) -> list[AlignedPhoto | None] | None:
    """The prediction in the world of the cameras that COLMAP placed; None where the two differ."""
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
    if pose_errors(before, after)["rotation"] > FARTHEST:
        return None
    similarity = similarity_between(before, after)
    return [None if one is None else one.mapped(similarity) for one in predicted]


def _adjusted(
    photos: Sequence[Photo],
    world: Sequence[AlignedPhoto | None],
    sure: Sequence[npt.NDArray[np.bool_] | None],
    found: Mapped,
    placed: Sequence[Camera | None],
    matches: Path,
    sift: bool,
    seed: int,
    show: Progress,
) -> Adjusted | None:
    """What bundle adjustment says, or None where photos share too few features."""
    confident = [
        None
        if one is None or known is None
        else replace(one, depth=np.where(known, one.depth, np.float32(np.nan)))
        for one, known in zip(world, sure, strict=True)
    ]
    predicted = {i: one.camera for i, one in enumerate(world) if one is not None}
    if sift:
        matches = matched_by_prediction(matches, confident, seed, show)
        matches = matched_along_lines(matches, set(predicted), show) or matches
    matches = without_contradictions(matches, confident)
    starts = predicted | {i: one for i, one in enumerate(placed) if one is not None}
    if len(with_matches(matches) & starts.keys()) < 2:
        return None
    lenses: dict[int, Sequence[float]] = {}
    if found.model is not None:
        for image in found.model.reg_image_ids():
            camera = found.model.images[image].camera
            lenses[camera.camera_id] = camera.params
    return adjusted(photos, starts, confident, usual_spread(world), matches, lenses, seed, show)


def _by_both(
    photos: Sequence[Photo],
    world: Sequence[AlignedPhoto | None],
    found: Mapped,
    result: Adjusted | None,
    network: str,
) -> Evidence:
    """Photo by photo, what features and prediction say together."""
    predicted = [None if one is None else one.camera for one in world]
    warnings = []
    if result is not None and _far_off(predicted, result):
        warnings.append(
            f"Bundle adjustment led too far from what {network} predicts, and is left out"
        )
        result = None
    usual = usual_spread(world)
    told = estimate_of(photos, found if result is None else replace(found, model=result.model))
    if result is None:
        by_features = told.cameras
        evidence = evidence_of_model(photos, told.cameras, found.model)
    else:
        by_features = [result.cameras.get(i) for i in range(len(photos))]
        evidence = {
            i: _evidence(covariance, usual)
            for i, covariance in result.covariances.items()
            if result.observed[i] >= FEWEST_POINTS
        }
    certain = [
        (before, after)
        for i, (before, after) in enumerate(zip(predicted, by_features, strict=True))
        if before is not None and after is not None and i in evidence
        if evidence[i].rests_on == "features"
    ]
    alone = _evidence_of_prediction(certain, usual)
    cameras: list[Camera | None] = []
    for i, (before, after) in enumerate(zip(predicted, by_features, strict=True)):
        cameras.append(after if i in evidence else before)
        if i not in evidence and before is not None:
            evidence[i] = alone
    rests = [evidence.get(i) for i in range(len(photos))]
    borne_out = {
        photo.name
        for photo, one in zip(photos, rests, strict=True)
        if one is not None and one.rests_on != "network"
    }
    points = _seen_by(told.points, borne_out)
    lenses = [
        lens if photo.name in borne_out else None
        for photo, lens in zip(photos, told.lenses or [None] * len(photos), strict=True)
    ]
    if found.alike:
        warnings.append(
            "Some photos show places that look alike: matches between them contradict others and "
            f"were left out (pairs of photos: {found.alike})."
        )
    warnings += _told(photos, rests, network)
    depths = _with_cameras(photos, world, cameras, points)
    return Evidence(cameras, depths, lenses, points, rests, warnings)


def _far_off(predicted: Sequence[Camera | None], result: Adjusted) -> bool:
    """Whether adjusted cameras are so far from the predicted ones that they must be wrong."""
    after, before = [], []
    for i, camera in result.cameras.items():
        wanted = predicted[i]
        if wanted is not None and result.observed[i] >= FEWEST_POINTS:
            after.append(camera)
            before.append(wanted)
    if len(after) < 2:
        return False
    changes = [a.K[0, 0] / b.K[0, 0] for a, b in zip(after, before, strict=True)]
    turned = pose_errors(after, before)["rotation"]
    return turned > FARTHEST or max(max(c, 1.0 / c) for c in changes) > STRETCHED


def usual_spread(world: Sequence[AlignedPhoto | None]) -> Spread:
    """Of predicted cameras, where nothing tells it; in units of the world of the prediction."""
    depths = [float(np.nanmedian(one.depth)) for one in world if one is not None]
    return Spread(float(np.radians(ROTATION)), CENTRE * float(np.median(depths or [1.0])))


def _evidence(covariance: Float64, usual: Spread) -> PoseEvidence:
    """What a camera with enough points rests on."""
    turn, move = deviations(covariance)
    alone = turn < FEATURES_ALONE * usual.rotation and move < FEATURES_ALONE * usual.centre
    return PoseEvidence("features" if alone else "both", float(np.degrees(turn)), move)


def _evidence_of_prediction(pairs: Sequence[tuple[Camera, Camera]], usual: Spread) -> PoseEvidence:
    """Of a camera that is as predicted: how far the prediction is from cameras that are known.

    Args:
        pairs: of predicted cameras and what features say of them.
        usual: where there are too few.
    """
    spread = usual
    if len(pairs) >= FEWEST_PLACED:
        before, after = (list(side) for side in zip(*pairs, strict=True))
        turn, move = spread_of(before, after)
        spread = Spread(
            float(np.clip(turn, LEAST * usual.rotation, MOST * usual.rotation)),
            float(np.clip(move, LEAST * usual.centre, MOST * usual.centre)),
        )
    return PoseEvidence("network", float(np.degrees(spread.rotation)), spread.centre)


def _seen_by(points: Points | None, names: set[str]) -> Points | None:
    """Points with the tracks of some photos alone."""
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
    """The predicted depths with other cameras, at the scale of the points that the photos see."""
    found: list[AlignedPhoto | None] = []
    for photo, one, camera in zip(photos, predicted, cameras, strict=True):
        if one is None or camera is None:
            found.append(None)
            continue
        pixels, depths = _points_of(photo.name, camera, points)
        known = one.depths_at(pixels)
        both = np.isfinite(known) & (depths > 0.0)
        if np.count_nonzero(both) >= FEWEST_POINTS:
            # The median of logarithms: one wrong point, or one edge, moves nothing.
            ratio = np.exp(np.median(np.log(depths[both] / known[both])))
            one = replace(one, depth=(one.depth * ratio).astype(np.float32))
        found.append(replace(one, camera=camera))
    return found


def _points_of(name: str, camera: Camera, points: Points | None) -> tuple[Float64, Float64]:
    """Where a photo sees points [M, 2], and their depths [M]."""
    if points is None or points.tracks is None or name not in points.tracks.names:
        return np.zeros((0, 2)), np.zeros(0)
    tracks = points.tracks
    own = tracks.view == tracks.names.index(name)
    xyz = points.xyz[tracks.point[own]]
    return tracks.xy[own], xyz @ camera.viewmat[2, :3] + camera.viewmat[2, 3]


def _told(
    photos: Sequence[Photo], evidence: Sequence[PoseEvidence | None], network: str
) -> list[str]:
    """What the user is told of cameras that features do not bear out."""
    placed = sum(one is not None for one in evidence)
    alone = [
        (photo.name, one)
        for photo, one in zip(photos, evidence, strict=True)
        if one is not None and one.rests_on == "network"
    ]
    if not alone:
        return []
    which = "all photos" if len(alone) == placed else listed([name for name, _ in alone])
    return [
        f"Cameras of {which} are as {network} predicts them, about {alone[0][1].rotation:.1f} "
        "degrees off about each axis: they share too few features with the others"
    ]
