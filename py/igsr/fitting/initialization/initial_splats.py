"""Initialization: one splat for each point of a set.

The points of each initialization are

* "points": those of the capture (COLMAP) and, of few photos with "auto", points between them;
* "depths": those of the capture, and points of the photos' depth maps (``given_depths``) or, if
  photos have none, triangulated matches and points between them (``matched_points``) and points of
  depth maps by stereo (``depth_maps``);
* "hull": in the visual hull of photos with alpha (``visual_hull``);
* "rays": on rays of photo pixels, at the depth where other photos agree best (``ray_depths``);
* "random": in the box that the cameras look at.

"auto" chooses the first that applies: depths if half of the photos have depth maps; points if there
are enough; hull if photos have alpha and there are no points; depths if half of the photos have
another one from a similar direction, or there are no points; rays if depths give too few.
"""

from __future__ import annotations

from typing import get_args

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Capture, Points, View
from igsr.errors import IgsrError
from igsr.fitting.initialization.depth_maps import depth_points, have_neighbors, viewed_target
from igsr.fitting.initialization.given_depths import given_points, have_depths
from igsr.fitting.initialization.matched_points import matched_points, with_points_between
from igsr.fitting.initialization.photo_pixels import at_most
from igsr.fitting.initialization.ray_depths import ray_points
from igsr.fitting.initialization.visual_hull import hull_points, viewed_box
from igsr.fitting.settings import Initialization
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]
Generator = np.random.Generator

#: Number of splats if the capture has no points and density control adds more.
DEFAULT_SPLATS = 20_000
#: Number of points from depth maps, as a fraction of the maximum number of splats.
DEPTHS_FRACTION = 0.5
#: Minimum fraction of photos with another one from a similar direction for depth maps.
MIN_NEIGHBORS_FRACTION = 0.5
#: Minimum number of points to start from.
MIN_POINTS = 100
#: Minimum number of triangulated features to start from.
MIN_FEATURES = 30
#: Photos in similar directions are matched, too, if there are at most this many, and points between
#: those of the capture are added: the points and depth maps of few photos have large gaps.
MAX_JOINED_PHOTOS = 12
#: Splats per triangulated feature; with many more, novel views get worse.
SPLATS_PER_FEATURE = 10
#: Number of splats of a random initialization (3DGS has 100 000, for many photos).
RANDOM_SPLATS = 10_000
#: Opacities of the least and the most confident points (3DGS starts all with the former), and the
#: factor on the size of the least confident.
MIN_OPACITY = 0.1
MAX_OPACITY = 0.5
UNSURE_SIZE_FACTOR = 1.5


def chosen_start(capture: Capture, start: str = "auto", wanted: int = DEFAULT_SPLATS) -> str:
    """Return the initialization that "auto" stands for, or ``start`` itself.

    ``initial_splats`` may still replace "depths" if it gives too few points.

    Args:
        capture: its train views are used.
        start: an ``Initialization``.
        wanted: enough points of the capture to need no others.

    Raises:
        IgsrError: the name is unknown, or the capture does not have what it needs.
    """
    names = get_args(Initialization)
    if start not in names:
        raise IgsrError(f"start must be one of {', '.join(names)}, not {start!r}.")
    points = 0 if capture.points is None else len(capture.points.xyz)
    views = capture.train_views
    has_alpha = all(view.image.shape[2] == 4 for view in views)
    if start == "points" and points < MIN_POINTS:
        raise IgsrError(
            f"{capture.path} has fewer than {MIN_POINTS} points to start from; use another start."
        )
    if start == "hull" and not has_alpha:
        raise IgsrError(
            f"{capture.path} has photos without alpha; start hull needs alpha in all photos."
        )
    if start != "auto":
        return start
    if have_depths(views):
        return "depths"
    if points >= wanted:
        return "points"
    if has_alpha:
        return "points" if points >= MIN_POINTS else "hull"
    return "points" if points >= MIN_POINTS and not _are_near(views, capture.points) else "depths"


def initial_splats(
    capture: Capture,
    seed: int,
    max_splats: int,
    sh_degree: int,
    start: str = "auto",
    *,
    dense: bool = False,
    exact_poses: bool = True,
    exact_focal: bool = True,
) -> tuple[Splats, str]:
    """Return the splats that a fit starts from, and the name of their initialization.

    Deterministic for a given seed.

    Args:
        capture: its train views and the points that at least two of them see are used.
        seed: random seed.
        max_splats: maximum number of splats.
        sh_degree: 0 to 4; coefficients above degree 0 start at zero.
        start: an ``Initialization``.
        dense: make ``max_splats`` splats if the capture has no points.
        exact_poses: allow "auto" to match photos from different directions.
        exact_focal: allow "auto" to match photos: splats that agree under a wrong focal length keep
            a fit from finding the right one.

    Returns:
        Splats relative to the median of their points, and the initialization ("points" ...).

    Raises:
        IgsrError: the name is unknown, the capture does not have what it needs, or poses, points
            or focal lengths are too extreme to place points.
    """
    if capture.points is not None:
        points = capture.points.seen_by(view.name for view in capture.train_views)
        capture = Capture(capture.path, capture.views, points)
    if start == "auto" and not (exact_poses and exact_focal):
        views = capture.train_views
        is_matched = chosen_start(capture, start) == "depths" and not have_depths(views)
        if is_matched and not (exact_focal and _are_near(views, capture.points)):
            known = 0 if capture.points is None else len(capture.points.xyz)
            start = "points" if known >= MIN_POINTS else "rays"
    try:
        # Overflow is found by the check of the splats, with a better message.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return _initial_splats(capture, seed, max_splats, sh_degree, start, dense)
    except IgsrError:
        raise
    except (ValueError, OverflowError) as error:  # numpy's LinAlgError is a ValueError
        raise IgsrError(
            f"{capture.path}: no splats can be placed in front of its cameras ({error}); check "
            "its poses, focal lengths and points."
        ) from error


def _initial_splats(
    capture: Capture, seed: int, max_splats: int, sh_degree: int, start: str, dense: bool
) -> tuple[Splats, str]:
    wanted = max_splats if dense else max(MIN_POINTS, round(DEPTHS_FRACTION * max_splats))
    asked, start = start, chosen_start(capture, start, wanted)
    random = np.random.default_rng([seed, 0x1617])
    points, views = capture.points, capture.train_views
    if start == "depths":
        xyz, colors, confidence = _with_depths(views, points, wanted, dense, random)
        if len(xyz) >= min(MIN_POINTS, wanted):
            return _splats_at(xyz, colors, confidence, sh_degree), start
        if asked != "auto":
            raise IgsrError(
                f"{capture.path}: depth maps and matches of its photos have only {len(xyz)} points "
                "in common, too few to start from; use start rays or random."
            )
        start = "points" if points is not None and len(points.xyz) >= MIN_POINTS else "rays"
    confidence = None
    if start == "points" and points is not None:
        xyz, values = points.xyz, points.rgb.astype(np.float64) / 255.0
        if points.confidence is not None:
            values = np.column_stack([values, points.confidence])
        if asked == "auto" and len(views) <= MAX_JOINED_PHOTOS:
            count = min(max_splats, DEFAULT_SPLATS, SPLATS_PER_FEATURE * len(xyz))
            xyz, values = with_points_between(xyz, values, count, random)
        xyz, values = at_most(max_splats, (xyz, values), random)
        colors = np.ascontiguousarray(values[:, :3])
        confidence = None if points.confidence is None else values[:, 3]
    elif start == "random":
        low, high = viewed_box([view.camera for view in views])
        count = min(RANDOM_SPLATS, max_splats)
        xyz, colors = random.uniform(low, high, size=(count, 3)), random.uniform(size=(count, 3))
    else:
        count = max_splats if dense else min(DEFAULT_SPLATS, max_splats)
        points_of = hull_points if start == "hull" else ray_points
        xyz, colors = points_of(views, count, random)
    return _splats_at(xyz, colors, confidence, sh_degree), start


def _with_depths(
    views: list[View], points: Points | None, wanted: int, dense: bool, random: Generator
) -> tuple[Float64, Float64, Float64 | None]:
    """Up to ``wanted`` points of the capture and depth maps, their colors and confidence."""
    known, rgb = np.zeros((0, 3)), np.zeros((0, 3))
    if points is not None:
        # Given depth maps cover the whole scene: leave half of the splats for them.
        limit = wanted // 2 if have_depths(views) else wanted
        known, rgb = at_most(limit, (points.xyz, points.rgb / 255.0), random)
    confidence = None
    if have_depths(views):
        xyz, colors, confidence = given_points(views, wanted - len(known), random)
        if confidence is not None:
            # Points of a capture are triangulated from several photos.
            confidence = np.concatenate([np.ones(len(known)), confidence])
    else:
        seeds, near = known, _are_near(views, points)
        if not len(known) and (len(views) <= MAX_JOINED_PHOTOS or not near):
            features = matched_points(views)
            if len(features[0]) >= MIN_FEATURES:
                limit = wanted // 2 if near else wanted
                if near or not dense:
                    limit = min(limit, DEFAULT_SPLATS, SPLATS_PER_FEATURE * len(features[0]))
                seeds = features[0]
                known, rgb = at_most(limit, with_points_between(*features, limit, random), random)
        xyz, colors = np.zeros((0, 3)), np.zeros((0, 3))
        if near:
            count = max(0, wanted - len(known))
            xyz, colors = depth_points(views, seeds if len(seeds) else None, count, random)
    return np.concatenate([known, xyz]), np.concatenate([rgb, colors]), confidence


def _are_near(views: list[View], points: Points | None) -> bool:
    """Whether enough photos have another one from a similar direction for stereo."""
    target = viewed_target(views, None if points is None else points.xyz)
    return have_neighbors(views, target, fraction=MIN_NEIGHBORS_FRACTION)


def _splats_at(xyz: Float64, colors: Float64, confidence: Float64 | None, sh_degree: int) -> Splats:
    """A splat at each point [P, 3] with its color [P, 3]."""
    # Relative to the median, so that float32 is precise near the scene.
    origin = np.median(xyz, axis=0)
    arrays = _core.splats_from_points(
        np.ascontiguousarray(xyz - origin, np.float32),
        np.ascontiguousarray(colors, np.float32),
        sh_degree,
    )
    if confidence is not None:
        _apply_confidence(arrays, confidence)
    return Splats(**arrays, origin=origin, antialiased=False)


def _apply_confidence(arrays: dict[str, npt.NDArray[np.float32]], confidence: Float64) -> None:
    """Make splats of low confidence fainter and larger, in place.

    By rank only, because the confidences of networks have no common unit.
    """
    levels, level = np.unique(confidence, return_inverse=True)
    if len(levels) < 2:
        return
    rank = level / (len(levels) - 1.0)
    opacity = MIN_OPACITY + rank * (MAX_OPACITY - MIN_OPACITY)
    arrays["opacities"] = np.log(opacity / (1.0 - opacity)).astype(np.float32)
    log_factor = (1.0 - rank) * np.log(UNSURE_SIZE_FACTOR)
    arrays["scales"] = (arrays["scales"] + log_factor[:, None]).astype(np.float32)
