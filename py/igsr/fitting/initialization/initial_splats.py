"""Initialization: the splats that a fit starts from.

There is one splat for each of some points. These are

* "points": the capture's own (COLMAP);
* "depths": these, and points of the depths that photos came with (``given_depths``), or else of
  depth maps by plane sweep that other photos confirm (``plane_sweep``);
* "hull": inside the visual hull of photos with alpha (``visual_hull``);
* "rays": on rays of photo pixels, at the depth where other photos agree best (``ray_depths``);
* "sift": triangulated features, and points between them (``sift_points``);
* "random": anywhere in the box that the cameras look at;
* "sfm": points where the capture has some, else random, as 3DGS starts.

"auto" is depths where half of the photos came with depths; points where the capture has as many as
splats are wanted; hull where photos have alpha and there are no points; depths where most photos
have another from a similar direction; else points where there are some, else sift, and rays where
there are too few features.
"""

from __future__ import annotations

from typing import get_args

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Capture, Points, View
from igsr.errors import IgsrError
from igsr.fitting.initialization.camera_coverage import looked_at_box
from igsr.fitting.initialization.given_depths import given_points, have_depths
from igsr.fitting.initialization.plane_sweep import can_sweep, looked_at, swept_points
from igsr.fitting.initialization.ray_depths import ray_points
from igsr.fitting.initialization.sift_points import sift_points, with_points_between
from igsr.fitting.initialization.visual_hull import hull_points
from igsr.fitting.settings import Initialization
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]
Generator = np.random.Generator

#: Splats where a capture has no points and density control adds more where they are needed. A fit
#: that adds none starts with as many as it may have.
MADE_UP_SPLATS = 20_000
#: Part of the most splats that depth maps start a fit with.
DEPTHS_PART = 0.5
#: Part of the photos that need another from a similar direction for depth maps.
SWEPT_PHOTOS = 0.5
#: Fewer points of a capture than this say too little of a scene's surface.
MIN_POINTS = 100
#: Opacity of the least and most confident points, where points have a confidence; others have the
#: former, as in 3DGS. The least confident are larger by this factor.
UNSURE_OPACITY, SURE_OPACITY = 0.1, 0.5
UNSURE_SIZE = 1.5

#: The names of initializations.
STARTS: tuple[str, ...] = get_args(Initialization)
#: Fewer triangulated features than this say nothing of a scene's shape.
MIN_FEATURES = 30
#: Splats per triangulated feature: itself and points between it and one of its nearest neighbours.
#: Many more of them fit the photos but not novel views.
SPLATS_PER_FEATURE = 10
#: Splats of a random initialization (3DGS has 100 000, for many photos).
RANDOM_SPLATS = 10_000


def chosen_start(capture: Capture, start: str = "auto", wanted: int = MADE_UP_SPLATS) -> str:
    """The initialization that "auto" or "sfm" stands for with this capture, or ``start`` itself.

    Where "auto" stands for "sift", too few features may still turn it into "rays"; where it stands
    for "depths", too few points that photos confirm into what it were without.

    Args:
        capture: its train views are used.
        start: a name of ``STARTS``.
        wanted: number of splats that would do to start from.

    Raises:
        IgsrError: there is no such initialization, or the capture has not what it needs.
    """
    if start not in STARTS:
        raise IgsrError(f"start must be one of {', '.join(STARTS)}, not {start!r}.")
    points = 0 if capture.points is None else len(capture.points.xyz)
    has_alpha = all(view.image.shape[2] == 4 for view in capture.train_views)
    if start == "points" and points < MIN_POINTS:
        raise IgsrError(
            f"{capture.path} has no {MIN_POINTS} points to start from; use another start."
        )
    if start == "hull" and not has_alpha:
        raise IgsrError(f"{capture.path} has photos without alpha; start hull needs it in all.")
    if start == "sfm":
        return "points" if points >= MIN_POINTS else "random"
    if start != "auto":
        return start
    if have_depths(capture.train_views):
        return "depths"
    if points >= wanted:
        return "points"
    if has_alpha:
        return "points" if points >= MIN_POINTS else "hull"
    views = capture.train_views
    target = looked_at(views, None if capture.points is None else capture.points.xyz)
    if can_sweep(views, target, part=SWEPT_PHOTOS):
        return "depths"
    return "points" if points >= MIN_POINTS else "sift"


def initial_splats(
    capture: Capture,
    seed: int,
    max_splats: int,
    sh_degree: int,
    start: str = "auto",
    *,
    dense: bool = False,
    exact_poses: bool = True,
) -> tuple[Splats, str]:
    """Splats to start a fit from, and what they were made from ("points", "hull" ...).

    Deterministic for a given seed.

    Args:
        capture: its train views are used, and the points that two of them see.
        seed: of the random choices.
        max_splats: at most so many.
        sh_degree: 0-4; coefficients above degree 0 start at zero.
        start: a name of ``STARTS``; see the module.
        dense: whether there are to be ``max_splats`` splats, where the capture has no points.
        exact_poses: whether "auto" may stand for "sift", which wrong poses mislead.

    Returns:
        The splats, relative to an origin in the middle of their points (the median), and the name
        of the initialization.

    Raises:
        IgsrError: there is no such initialization, the capture has not what it needs, or no points
            can be placed: the poses, points or focal lengths are too extreme.
    """
    if capture.points is not None:
        points = capture.points.seen_by(view.name for view in capture.train_views)
        capture = Capture(capture.path, capture.views, points)
    if start == "auto" and not exact_poses and chosen_start(capture, start) == "sift":
        start = "rays"
    try:
        # What overflows is found by the check of the points; numpy's warnings would say less.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return _placed_splats(capture, seed, max_splats, sh_degree, start, dense)
    except IgsrError:
        raise
    except (ValueError, OverflowError) as error:  # numpy's LinAlgError is a ValueError
        raise IgsrError(
            f"{capture.path}: no splats can be placed before its cameras ({error}); check its "
            "poses, focal lengths and points."
        ) from error


def _placed_splats(
    capture: Capture, seed: int, max_splats: int, sh_degree: int, start: str, dense: bool
) -> tuple[Splats, str]:
    wanted = max_splats if dense else max(MIN_POINTS, round(DEPTHS_PART * max_splats))
    asked, start = start, chosen_start(capture, start, wanted)
    random = np.random.default_rng([seed, 0x1617])
    points, views = capture.points, capture.train_views
    if start == "depths":
        xyz, colors, confidence = _with_depths(views, points, wanted, random)
        if len(xyz) >= MIN_POINTS:
            return _splats_at(xyz, colors, confidence, sh_degree), start
        if asked != "auto":
            raise IgsrError(
                f"{capture.path}: the photos' depth maps agree in {len(xyz)} points only, too few "
                "to start from; use start auto or random."
            )
        start = "points" if points is not None and len(points.xyz) >= MIN_POINTS else "sift"
    confidence = None
    features = sift_points(views) if start == "sift" else None
    if features is not None and len(features[0]) < MIN_FEATURES:
        if asked != "auto":
            raise IgsrError(
                f"{capture.path}: only {len(features[0])} points could be triangulated from "
                "features of its photos, too few to start from; use start rays or random."
            )
        start = "rays"
    if start == "points" and points is not None:
        confidence = points.confidence
        xyz, colors = points.xyz, points.rgb.astype(np.float64) / 255.0
        chosen = _at_most(max_splats, len(xyz), random)
        xyz, colors = xyz[chosen], colors[chosen]
        confidence = None if confidence is None else confidence[chosen]
    elif start == "sift" and features is not None:
        made = min(MADE_UP_SPLATS, SPLATS_PER_FEATURE * len(features[0]))
        xyz, colors = with_points_between(*features, max_splats if dense else made, random)
        chosen = _at_most(max_splats, len(xyz), random)
        xyz, colors = xyz[chosen], colors[chosen]
    elif start == "random":
        low, high = looked_at_box([view.camera for view in views])
        count = min(RANDOM_SPLATS, max_splats)
        xyz, colors = random.uniform(low, high, size=(count, 3)), random.uniform(size=(count, 3))
    else:
        count = max_splats if dense else min(MADE_UP_SPLATS, max_splats)
        if start == "hull":
            xyz, colors = hull_points(views, count, random)
        else:
            xyz, colors = ray_points(views, count, random)
    return _splats_at(xyz, colors, confidence, sh_degree), start


def _with_depths(
    views: list[View], points: Points | None, wanted: int, random: Generator
) -> tuple[Float64, Float64, Float64 | None]:
    """Points of depths and, where there are some, the capture's, ``wanted`` in all.

    With their colors and, where photos came with depths that have a confidence, theirs.
    """
    known, rgb = np.zeros((0, 3)), np.zeros((0, 3))
    if points is not None:
        # Depths that came with the photos show all of the scene; half of the room is theirs.
        most = wanted // 2 if have_depths(views) else wanted
        chosen = _at_most(most, len(points.xyz), random)
        known, rgb = points.xyz[chosen], points.rgb[chosen] / 255.0
    confidence = None
    if have_depths(views):
        dense, colors, confidence = given_points(views, wanted - len(known), random)
        if confidence is not None:
            # Points of a capture are triangulated from several photos.
            confidence = np.concatenate([np.ones(len(known)), confidence])
    else:
        places = known if len(known) else None
        dense, colors = swept_points(views, places, wanted - len(known), random)
    return np.concatenate([known, dense]), np.concatenate([rgb, colors]), confidence


def _splats_at(xyz: Float64, colors: Float64, confidence: Float64 | None, sh_degree: int) -> Splats:
    """A splat at each point [P, 3], of its color [P, 3], by the points' confidence [P]."""
    # Relative to the middle, so that float32 is precise where the scene is.
    origin = np.median(xyz, axis=0)
    arrays = _core.splats_from_points(
        (xyz - origin).astype(np.float32), colors.astype(np.float32), sh_degree
    )
    if confidence is not None:
        _follow_confidence(arrays, confidence)
    return Splats(**arrays, origin=origin, antialiased=False)


def _at_most(most: int, count: int, random: Generator) -> npt.NDArray[np.int64]:
    """Indices of ``most`` of ``count`` points, or of all where they are not more."""
    if count <= most:
        return np.arange(count)
    return np.sort(random.choice(count, size=most, replace=False))


def _follow_confidence(arrays: dict[str, npt.NDArray[np.float32]], confidence: Float64) -> None:
    """Make points of low confidence faint and larger, by the order of confidence [P]; in place.

    The order alone, since networks' confidences have no common unit. Where all are equal, they say
    nothing.
    """
    levels, level = np.unique(confidence, return_inverse=True)
    if len(levels) < 2:
        return
    rank = level / (len(levels) - 1.0)
    opacity = UNSURE_OPACITY + rank * (SURE_OPACITY - UNSURE_OPACITY)
    arrays["opacities"] = np.log(opacity / (1.0 - opacity)).astype(np.float32)
    larger = (1.0 - rank) * np.log(UNSURE_SIZE)
    arrays["scales"] = (arrays["scales"] + larger[:, None]).astype(np.float32)
