"""The splats that a fit starts from.

Where the capture has points (COLMAP), one splat per point. Where it has none, points are made up:
inside the visual hull where photos have alpha, else, where photos look from similar directions,
along the rays of photo pixels at the depth where the other photos agree best (``plane_sweep``).
Where photos look from further apart, features that they have in common are triangulated
(``sift_points``) and points put between them; where there are too few of those, rays are compared
by the pixels' colours.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Camera, Capture, View
from igsr.errors import IgsrError
from igsr.fitting.initialization.plane_sweep import can_sweep, swept_points
from igsr.fitting.initialization.sift_points import sift_points
from igsr.geometry.focus_point import focus_point
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]
Generator = np.random.Generator

#: Splats made up where a capture has no points and density control adds more where they are needed.
#: A fit that adds none starts with as many as it may have.
MADE_UP_SPLATS = 20_000
#: Fewer points than this say too little of a scene's surface to start from them alone.
MIN_POINTS = 100
#: Depths tried per ray, and their range in units of the distance to what the cameras look at.
RAY_DEPTHS = 32
NEAREST_DEPTH, FARTHEST_DEPTH = 0.25, 8.0
#: Photos compared with per ray, and up to which points of the hull are compared: more cost time and
#: see other sides of the scene.
COMPARED_VIEWS = 24
#: Part of the hull's points that is taken for a start, by how well photos agree on their colours.
AGREEING = 0.5
#: Opacity of the least and most confident points, where points have a confidence; others have the
#: former, as in 3DGS. The least confident are larger by this factor.
UNSURE_OPACITY, SURE_OPACITY = 0.1, 0.5
UNSURE_SIZE = 1.5

#: Where the splats of a start may come from.
STARTS = ("auto", "points", "hull", "sift", "rays", "random")
#: Degrees to the nearest other photo up to which sweeping gives better starts than features do.
SWEEP_BEFORE_SIFT = 30.0
#: Fewer triangulated features than this say nothing of a scene's shape.
MIN_FEATURES = 30
#: Splats per triangulated feature: itself and points between it and one of its nearest neighbours.
#: Many more of them fit the photos but not the views between.
SPLATS_PER_FEATURE = 10
FEATURE_NEIGHBOURS = 5
#: Splats of a random start (3DGS has 100 000 for many photos; the design's baseline has these).
RANDOM_SPLATS = 10_000


def chosen_start(capture: Capture, start: str = "auto") -> str:
    """What a start is made from: what "auto" stands for with this capture, or ``start`` itself.

    Where "auto" stands for "sift", too few features may still turn it into "rays".

    Raises:
        IgsrError: the capture has not what ``start`` asks for, or there is no such start.
    """
    if start not in STARTS:
        raise IgsrError(f"start must be one of {', '.join(STARTS)}, not {start!r}.")
    has_points = capture.points is not None and len(capture.points.xyz) >= MIN_POINTS
    has_alpha = all(view.image.shape[2] == 4 for view in capture.train_views)
    if start == "points" and not has_points:
        raise IgsrError(
            f"{capture.path} has no {MIN_POINTS} points to start from; use another start."
        )
    if start == "hull" and not has_alpha:
        raise IgsrError(f"{capture.path} has photos without alpha; start hull needs it in all.")
    if start != "auto":
        return start
    if has_points or has_alpha:
        return "points" if has_points else "hull"
    views = capture.train_views
    target = focus_point([view.camera for view in views])
    return "rays" if can_sweep(views, target, SWEEP_BEFORE_SIFT) else "sift"


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

    The same arguments give the same splats.

    Args:
        capture: its train views are used, and the points that two of them see.
        seed: of the random choices.
        max_splats: at most so many.
        sh_degree: 0-4; coefficients above degree 0 start at zero.
        start: "points" (the capture's), "hull" (inside the visual hull of photos with alpha),
            "sift" (features that photos have in common, triangulated, and points between them),
            "rays" (where photos agree best along each other's rays), "random" (uniform in the box
            that the cameras look at, with random colours), or "auto": points, else hull, else rays
            where each photo has another from a similar direction, else sift, else rays.
        dense: whether points are made up for all of ``max_splats``.
        exact_poses: whether "auto" may stand for "sift", which wrong poses mislead.

    Raises:
        IgsrError: there is no such start, the capture has not what it needs, or no points can be
            placed: the poses, points or focal lengths are too extreme.
    """
    if capture.points is not None:
        points = capture.points.seen_by(view.name for view in capture.train_views)
        capture = Capture(capture.path, capture.views, points)
    if start == "auto" and not exact_poses and chosen_start(capture) == "sift":
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
    asked, start = start, chosen_start(capture, start)
    random = np.random.default_rng([seed, 0x1617])
    points, views = capture.points, capture.train_views
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
        xyz, colors = _with_between(*features, max_splats if dense else made, random)
        chosen = _at_most(max_splats, len(xyz), random)
        xyz, colors = xyz[chosen], colors[chosen]
    elif start == "random":
        low, high = _looked_at_box([view.camera for view in views])
        count = min(RANDOM_SPLATS, max_splats)
        xyz, colors = random.uniform(low, high, size=(count, 3)), random.uniform(size=(count, 3))
    else:
        count = max_splats if dense else min(MADE_UP_SPLATS, max_splats)
        target = focus_point([view.camera for view in views])
        if start == "hull":
            xyz, colors = _inside_hull(views, count, random)
        elif can_sweep(views, target):
            xyz, colors = swept_points(views, target, count, random)
        else:
            xyz, colors = _along_rays(views, count, random)
    # Relative to the middle, so that float32 is precise where the scene is.
    origin = np.median(xyz, axis=0)
    arrays = _core.splats_from_points(
        (xyz - origin).astype(np.float32), colors.astype(np.float32), sh_degree
    )
    if confidence is not None:
        _follow_confidence(arrays, confidence)
    return Splats(**arrays, origin=origin, antialiased=False), start


def _at_most(most: int, count: int, random: Generator) -> npt.NDArray[np.int64]:
    """Indices of ``most`` of ``count`` points, or of all where they are not more."""
    if count <= most:
        return np.arange(count)
    return np.sort(random.choice(count, size=most, replace=False))


def _with_between(
    xyz: Float64, colors: Float64, count: int, random: Generator
) -> tuple[Float64, Float64]:
    """The points, and as many as ``count`` asks for between them and their nearest neighbours."""
    more = max(0, count - len(xyz))
    points = random.integers(len(xyz), size=more)
    # From the middle, where products of coordinates are small enough to tell points apart.
    local = xyz - np.median(xyz, axis=0)
    squares = (local**2).sum(axis=1)
    others = np.empty(more, dtype=np.int64)
    # In parts, which bounds memory.
    for part in np.array_split(np.arange(more), 1 + more // 1024):
        own = points[part]
        apart = squares - 2.0 * local[own] @ local.T
        apart[np.arange(len(own)), own] = np.inf
        near = np.argpartition(apart, FEATURE_NEIGHBOURS, axis=1)[:, :FEATURE_NEIGHBOURS]
        others[part] = near[np.arange(len(own)), random.integers(near.shape[1], size=len(own))]
    way = random.uniform(size=(more, 1))
    return (
        np.concatenate([xyz, xyz[points] + way * (xyz[others] - xyz[points])]),
        np.concatenate([colors, colors[points] + way * (colors[others] - colors[points])]),
    )


def _follow_confidence(arrays: dict[str, npt.NDArray[np.float32]], confidence: Float64) -> None:
    """Make unsure points faint and larger, by the order of their confidence [P]; in place.

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


def _looked_at_box(cameras: list[Camera]) -> tuple[Float64, Float64]:
    """Corners [3] of the cube around what the cameras look at that their pictures hold."""
    target = focus_point(cameras)
    distances = [float(np.linalg.norm(camera.centre - target)) for camera in cameras]
    tangents = [0.5 * max(c.width / c.K[0, 0], c.height / c.K[1, 1]) for c in cameras]
    half_side = float(np.median(distances) * np.median(tangents))
    return target - half_side, target + half_side


def _pixels(view: View, xyz: Float64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Flat pixel index [P] of world points in a view, and which of them fall into it."""
    camera = view.camera
    local = xyz @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = np.maximum(local[:, 2], 1e-9)
    x = np.floor(camera.K[0, 0] * local[:, 0] / z + camera.K[0, 2])
    y = np.floor(camera.K[1, 1] * local[:, 1] / z + camera.K[1, 2])
    inside = (local[:, 2] > 1e-9) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    index = np.where(inside, y * camera.width + x, 0).astype(np.int64)
    if view.mask is not None:
        inside &= view.mask.reshape(-1)[index]
    return index, inside


def _inside_hull(views: list[View], count: int, random: Generator) -> tuple[Float64, Float64]:
    """Points whose pixel has alpha in every photo that sees them, coloured by those photos.

    Few photos leave a hull that is much larger than the object: of its points those are taken on
    whose colour photos agree best.
    """
    compare = len(views) <= COMPARED_VIEWS
    tries = 16 if compare else 4
    # Thin objects fill little of the box: shrink it to what survives and draw again.
    low, high = _looked_at_box([view.camera for view in views])
    found, colors = np.zeros((0, 3)), np.zeros((0, 3))
    for _ in range(8):
        candidates = random.uniform(low, high, size=(tries * count, 3))
        for view in views:
            index, in_view = _pixels(view, candidates)
            candidates = candidates[~in_view | (view.image.reshape(-1, 4)[index, 3] > 0)]
        seen_colors = np.full((len(views), len(candidates), 3), np.nan, dtype=np.float32)
        for v, view in enumerate(views):
            index, in_view = _pixels(view, candidates)
            seen_colors[v, in_view] = view.image.reshape(-1, 4)[index[in_view], :3] / 255.0
        kept = np.isfinite(seen_colors[..., 0]).any(axis=0)
        if compare and kept.any():
            disagreement = _disagreement(seen_colors)
            kept &= disagreement <= np.quantile(disagreement[kept], AGREEING, method="lower")
        candidates, seen_colors = candidates[kept], seen_colors[:, kept]
        found = np.concatenate([found, candidates])
        if len(candidates):
            colors = np.concatenate([colors, np.nanmean(seen_colors, axis=0, dtype=np.float64)])
        if len(found) >= count:
            break
        if len(candidates):
            margin = 0.1 * (high - low)
            low = np.maximum(low, candidates.min(axis=0) - margin)
            high = np.minimum(high, candidates.max(axis=0) + margin)
    if len(found) < MIN_POINTS:
        # The cameras do not agree on any hull; a box to start from is better than nothing.
        return random.uniform(low, high, size=(count, 3)), np.full((count, 3), 0.5)
    return found[:count], colors[:count]


def _disagreement(colors: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Per point how far the colours are apart in the half of the photos that agree best on it.

    In the other half something may stand before the point.

    Args:
        colors: [views, points, 3], NaN where a photo does not see the point.
    """
    half = min(len(colors), max(2, len(colors) // 2))
    least = np.full(colors.shape[1], np.inf, dtype=np.float32)
    for own in colors:
        apart = np.abs(colors - own).mean(axis=2)
        apart = np.where(np.isnan(apart), np.float32(np.inf), apart)
        least = np.minimum(least, np.partition(apart, half - 1, axis=0)[:half].mean(axis=0))
    return least


def _along_rays(views: list[View], count: int, random: Generator) -> tuple[Float64, Float64]:
    """Points on the rays of random pixels, at the depth where other photos agree best."""
    target = focus_point([view.camera for view in views])
    depths = np.geomspace(NEAREST_DEPTH, FARTHEST_DEPTH, RAY_DEPTHS)
    compared = [_softened(view) for view in views]
    centres = np.stack([view.camera.centre for view in views])
    per_view = np.bincount(random.integers(len(views), size=count), minlength=len(views))
    points, colors = [], []
    for v, (view, rays) in enumerate(zip(views, per_view, strict=True)):
        usable = np.arange(view.camera.width * view.camera.height)
        if view.mask is not None:
            usable = np.flatnonzero(view.mask)
        pixel = random.choice(usable, size=rays)
        camera = view.camera
        columns, rows = pixel % camera.width + 0.5, pixel // camera.width + 0.5
        directions = np.stack(
            [
                (columns - camera.K[0, 2]) / camera.K[0, 0],
                (rows - camera.K[1, 2]) / camera.K[1, 1],
                np.ones(rays),
            ],
            axis=1,
        )
        reach = float(np.linalg.norm(target - camera.centre))
        # Jitter each ray's depths, or all points would lie on a few shells.
        jitter = np.exp(random.uniform(-0.5, 0.5, size=rays) * np.log(depths[1] / depths[0]))
        z = reach * depths[None, :] * jitter[:, None]
        local = directions[:, None, :] * z[..., None] - camera.viewmat[:3, 3]
        world = (local @ camera.viewmat[:3, :3]).reshape(-1, 3)
        own = compared[v][pixel]
        near = np.argsort(np.linalg.norm(centres - centres[v], axis=1), kind="stable")
        errors = []
        for other in near[1 : COMPARED_VIEWS + 1]:
            index, inside = _pixels(views[other], world)
            difference = np.abs(
                compared[other][index].reshape(rays, RAY_DEPTHS, 3) - own[:, None, :]
            ).mean(axis=2)
            errors.append(np.where(inside.reshape(rays, RAY_DEPTHS), difference, np.nan))
        best = (
            _most_agreed(np.stack(errors), random)
            if errors
            else random.integers(RAY_DEPTHS, size=rays)
        )
        points.append(world.reshape(rays, RAY_DEPTHS, 3)[np.arange(rays), best])
        colors.append(view.image.reshape(-1, view.image.shape[2])[pixel, :3] / 255.0)
    return np.concatenate(points), np.concatenate(colors)


def _most_agreed(errors: Float64, random: Generator) -> npt.NDArray[np.int64]:
    """Per ray the depth whose median error over the views is lowest.

    Args:
        errors: [views, rays, depths], NaN where a view does not see the point.
    """
    seen = np.isfinite(errors).sum(axis=0)
    ordered = np.sort(np.where(np.isfinite(errors), errors, np.inf), axis=0)
    # The lower median over those that see it: the rest may be hidden behind something.
    middle = np.maximum(seen - 1, 0) // 2
    cost = np.take_along_axis(ordered, middle[None], axis=0)[0]
    # What a single view sees agrees with it by chance, at any depth.
    cost = np.where(seen >= min(3, len(errors)), cost, 2.0)
    # Ties (flat colour, nothing seen) must not all fall to the nearest depth.
    cost = cost + 1e-3 * random.uniform(size=cost.shape)
    return np.asarray(cost.argmin(axis=1))


def _softened(view: View) -> npt.NDArray[np.float32]:
    """The photo's colours [H * W, 3] in 0..1, blurred by 5 x 5 pixels: poses are not that exact."""
    image = view.image[..., :3].astype(np.float32) / 255.0
    for axis in (0, 1):
        padded = np.concatenate(
            [np.take(image, [0, 0], axis=axis), image, np.take(image, [-1, -1], axis=axis)],
            axis=axis,
        )
        length = image.shape[axis]
        image = np.mean(
            [np.take(padded, range(i, i + length), axis=axis) for i in range(5)], axis=0
        )
    return image.reshape(-1, 3)
