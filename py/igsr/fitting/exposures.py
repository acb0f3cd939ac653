"""Initial exposures of photos, estimated from the colors of points that several photos share.

The logarithm of a point's color in a photo is the photo's log gain plus a value of the point. Log
gains are the robust least-squares solution (Cauchy weights, iteratively reweighted). Their standard
errors come from a delete-one-group jackknife (Efron and Stein 1981) over groups of nearby points,
because highlights, vignetting and shadows affect nearby points alike.

"auto" optimizes exposures if gains differ by ``MIN_SPREAD`` or more, beyond their errors, between
photos that share most points. A gain that drifts along a sequence of photos is
no reason: view-dependent color can represent it. Without tracks, EXIF decides if all photos have
it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture import Exposure, Points, PseudoView, View
from igsr.fitting.settings import ExposureMode

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: Minimum spread of log gains for "auto" to optimize exposures: a sixth of a stop. Each photo is
#: compared with this many others.
MIN_SPREAD = 0.05
COMPARED_PHOTOS = 2
#: Log of encoded (sRGB) brightness per stop: encoding is about a power of 1 / 2.2.
LOG_GAIN_PER_STOP = float(np.log(2.0) / 2.2)
#: A point's color in a photo is the mean of a patch of this side, pixels.
PATCH_SIDE = 5
#: Patches with pixels outside these levels are not used: noise and clipping.
MIN_LEVEL = 10
MAX_LEVEL = 250
#: Minimum number of shared points for a photo's gain to be used.
MIN_POINTS = 30
JACKKNIFE_GROUPS = 8
#: The weight of the penalty on the distance from an initial exposure is the square of this standard
#: error of its log gain over its own, up to the maximum.
UNIT_WEIGHT_ERROR = 0.03
MAX_WEIGHT = 100.0
#: Standard errors of log gains from EXIF, and from an earlier fit.
EXIF_ERROR = 0.1
FITTED_ERROR = 0.02
POINTS_PER_TABLE = 4096
REWEIGHTING_ROUNDS = 12
AFFINE_ROUNDS = 50
#: Standard deviation of the prior on offsets, and the maximum gain.
OFFSET_DEVIATION = 0.05
MAX_GAIN = 16.0


@dataclass(frozen=True, eq=False)
class RelativeGains:
    """Gains of photos relative to each other.

    Attributes:
        log_gain: float64 [V, 3], with zero mean over the photos whose gain is known.
        error: float64 [V, 3], standard errors; infinite where the gain is unknown.
        spread: root mean square difference of log gains from those of the photos that share most
            points, over the square root of 2, with the errors subtracted: the standard deviation
            of gains that are independent between photos.
    """

    log_gain: Float64
    error: Float64
    spread: float


@dataclass(frozen=True, eq=False)
class StartingExposures:
    """Initial exposures of V views.

    Attributes:
        exposures: of each view; None for pseudo-views, which have the splats' colors.
        pulls: float64 [V], weight of the penalty on the distance from the initial exposure: the
            loss grows by this times half the squared change of log gains and offsets. A slope of
            the loss of 0.01, as a poor render can have, moves them by at most 0.01 / pull.
    """

    exposures: list[Exposure | None]
    pulls: Float64


def starting_exposures(
    views: Sequence[View], points: Points | None, mode: ExposureMode
) -> StartingExposures | None:
    """Return the initial exposures of views; None if exposures are not optimized.

    Views that already have an exposure start from it.

    Args:
        views: the views to fit.
        points: of the capture.
        mode: "auto", "on" or "off".
    """
    if mode == "off":
        return None
    photos = [view for view in views if not isinstance(view, PseudoView)]
    if any(view.exposure is not None for view in photos):
        exposures = [view.exposure or Exposure() for view in photos]
        error = np.full(len(photos), FITTED_ERROR)
    else:
        observations = _observe(photos, points)
        gains = _gains(observations, len(photos)) or gains_from_exif(photos)
        if mode == "auto" and (gains is None or gains.spread < MIN_SPREAD):
            return None
        log_gain = np.zeros((len(photos), 3)) if gains is None else gains.log_gain
        exposures = _affine(observations, log_gain)
        error = np.full(len(photos), np.inf)
        if gains is not None:
            error = np.sqrt(np.mean(gains.error**2, axis=1))
    weight = np.minimum(MAX_WEIGHT, (UNIT_WEIGHT_ERROR / np.maximum(error, 1e-9)) ** 2)
    each = iter(zip(exposures, weight, strict=True))
    rows = [(None, 0.0) if isinstance(view, PseudoView) else next(each) for view in views]
    return StartingExposures([row[0] for row in rows], np.array([row[1] for row in rows]))


def gains_from_exif(photos: Sequence[View]) -> RelativeGains | None:
    """Return gains from exposure values; None if a photo has none."""
    stops = [photo.exposure_value for photo in photos]
    if not stops or any(value is None for value in stops):
        return None
    log_gain = LOG_GAIN_PER_STOP * np.array(stops, np.float64)
    rows = np.repeat((log_gain - log_gain.mean())[:, None], 3, axis=1)
    return RelativeGains(rows, np.full_like(rows, EXIF_ERROR), float(log_gain.std()))


def gains_from_points(photos: Sequence[View], points: Points | None) -> RelativeGains | None:
    """Return gains from the colors of shared points; None without tracks.

    Args:
        photos: V photos.
        points: with tracks.
    """
    return _gains(_observe(photos, points), len(photos))


@dataclass(frozen=True, eq=False)
class _Observations:
    """M observations of points in photos.

    Attributes:
        view: int64 [M], photo of each.
        point: int64 [M], numbers from 0 without gaps; each point has at least two observations.
        color: float64 [M, 3] in (0, 1].
        group: int64 [M], group of the jackknife.
    """

    view: Int64
    point: Int64
    color: Float64
    group: Int64


def _observe(photos: Sequence[View], points: Points | None) -> _Observations | None:
    """Colors of shared points; None if there are none."""
    if points is None or points.tracks is None or len(photos) < 2:
        return None
    tracks = points.tracks
    index = {name: k for k, name in enumerate(tracks.names)}
    views, numbers, colors = [], [], []
    for k, photo in enumerate(photos):
        of_photo = np.flatnonzero(tracks.view == index.get(photo.name, -1))
        patches, usable = _patch_colors(photo, tracks.xy[of_photo])
        views.append(np.full(int(usable.sum()), k))
        numbers.append(tracks.point[of_photo][usable])
        colors.append(patches[usable])
    view, point, color = np.concatenate(views), np.concatenate(numbers), np.concatenate(colors)
    shared = np.bincount(point, minlength=len(points.xyz))[point] >= 2
    view, point, color = view[shared], point[shared], color[shared]
    if not len(view):
        return None
    group = _jackknife_groups(points.xyz, point)
    _, point = np.unique(point, return_inverse=True)
    return _Observations(view, point, color, group)


def _patch_colors(photo: View, xy: Float64) -> tuple[Float64, Bool]:
    """Mean colors [M, 3] in (0, 1] around pixel coordinates, and which of them are usable."""
    height, width = photo.image.shape[:2]
    half = PATCH_SIDE // 2
    column, row = np.floor(xy).astype(np.int64).T
    usable = (column >= half) & (row >= half) & (column < width - half) & (row < height - half)
    column, row = np.where(usable, column, half), np.where(usable, row, half)
    if min(height, width) < PATCH_SIDE:
        return np.ones((len(xy), 3)), np.zeros(len(xy), np.bool_)
    offsets = np.arange(PATCH_SIDE) - half
    rows, columns = row[:, None, None] + offsets[:, None], column[:, None, None] + offsets
    pixels = photo.image[rows, columns]
    colors = pixels[..., :3]
    usable &= (colors.min(axis=(1, 2, 3)) >= MIN_LEVEL) & (colors.max(axis=(1, 2, 3)) <= MAX_LEVEL)
    if photo.image.shape[2] == 4:
        usable &= pixels[..., 3].min(axis=(1, 2)) == 255
    if photo.mask is not None:
        usable &= photo.mask[rows, columns].all(axis=(1, 2))
    means = colors.mean(axis=(1, 2), dtype=np.float64) / 255.0
    return np.maximum(means, 1.0 / 255.0), usable


def _jackknife_groups(xyz: Float64, point: Int64) -> Int64:
    """Group of each observation, by the position of its point along the points' longest axis."""
    used = np.unique(point)
    centered = xyz[used] - np.median(xyz[used], axis=0)
    # A few distant points must not determine the axis.
    distance = np.linalg.norm(centered, axis=1)
    inner = centered[distance <= np.quantile(distance, 0.9)]
    axis = np.linalg.svd(inner, full_matrices=False)[2][0]
    order = np.argsort(np.argsort(centered @ axis))
    group = np.zeros(len(xyz), np.int64)
    group[used] = order * JACKKNIFE_GROUPS // len(used)
    return group[point]


def _gains(observations: _Observations | None, photos: int) -> RelativeGains | None:
    if observations is None:
        return None
    view, point, log_color = observations.view, observations.point, np.log(observations.color)
    gains, counts = _solve_gains(view, point, log_color, photos)
    kept = [np.flatnonzero(observations.group != k) for k in range(JACKKNIFE_GROUPS)]
    parts = np.stack([_solve_gains(view[k], point[k], log_color[k], photos)[0] for k in kept])
    known = counts >= MIN_POINTS
    if known.sum() < 2:
        return None
    error = _jackknife_error(parts)
    spread = _spread(observations, gains, parts, known)
    log_gain = np.where(known[:, None], gains - gains[known].mean(axis=0), 0.0)
    return RelativeGains(log_gain, np.where(known[:, None], error, np.inf), spread)


def _jackknife_error(parts: Float64) -> Float64:
    """Standard error of a value from its estimates without each group, [JACKKNIFE_GROUPS, ...]."""
    squares = np.sum((parts - parts.mean(axis=0)) ** 2, axis=0)
    return np.asarray(np.sqrt((JACKKNIFE_GROUPS - 1) / JACKKNIFE_GROUPS * squares))


def _spread(observations: _Observations, gains: Float64, parts: Float64, known: Bool) -> float:
    """``RelativeGains.spread``; ``parts`` are the log gains without each group."""
    shared = _shared_points(observations, len(gains))
    shared[~known] = shared[:, ~known] = 0.0
    square, number = 0.0, 0
    for photo in np.flatnonzero(known):
        for other in np.argsort(-shared[photo], kind="stable")[:COMPARED_PHOTOS]:
            if shared[photo, other] > 0.0:
                error = _jackknife_error(parts[:, photo] - parts[:, other])
                square += float(np.mean((gains[photo] - gains[other]) ** 2 - error**2))
                number += 1
    return float(np.sqrt(max(0.0, square / max(number, 1) / 2.0)))


def _shared_points(observations: _Observations, photos: int) -> Float64:
    """Number of points that each pair of photos shares, [V, V], with a zero diagonal."""
    shared = np.zeros((photos, photos))
    ones = np.ones(len(observations.view))
    for table in _tables(observations.view, observations.point, ones, photos):
        shared += (table > 0.0).astype(np.float64).T @ (table > 0.0)
    np.fill_diagonal(shared, 0.0)
    return shared


def _tables(view: Int64, point: Int64, values: Float64, photos: int) -> Iterator[Float64]:
    """Values by point and photo, [P', V], for ``POINTS_PER_TABLE`` points at a time."""
    for start in range(0, int(point.max()) + 1, POINTS_PER_TABLE):
        rows = np.flatnonzero((point >= start) & (point < start + POINTS_PER_TABLE))
        table = np.zeros((min(POINTS_PER_TABLE, int(point.max()) + 1 - start), photos))
        np.add.at(table, (point[rows] - start, view[rows]), values[rows])
        yield table


def _solve_gains(
    view: Int64, point: Int64, log_color: Float64, photos: int
) -> tuple[Float64, Int64]:
    """Log gains [V, 3] with zero mean, and the number [V] of shared points of each photo."""
    kept = np.bincount(point)[point] >= 2
    view, point, log_color = view[kept], point[kept], log_color[kept]
    _, point = np.unique(point, return_inverse=True)
    counts = np.bincount(view, minlength=photos)
    gains = np.zeros((photos, 3))
    if len(view):
        for channel in range(3):
            gains[:, channel] = _solve_channel(view, point, log_color[:, channel], photos)
    return gains, counts


def _solve_channel(view: Int64, point: Int64, values: Float64, photos: int) -> Float64:
    """Log gains [V] of one channel; zero for photos that share no point."""
    weights: Float64 = np.ones(len(values))
    gains: Float64 = np.zeros(photos)
    for _ in range(REWEIGHTING_ROUNDS):
        # Normal equations with the points' colors eliminated (Schur complement).
        point_weight = np.bincount(point, weights)
        color = np.bincount(point, weights * values) / point_weight
        right = np.bincount(view, weights * (values - color[point]), minlength=photos)
        matrix: Float64 = np.diag(np.bincount(view, weights, minlength=photos)).astype(np.float64)
        for number, table in enumerate(_tables(view, point, weights, photos)):
            totals = point_weight[number * POINTS_PER_TABLE :][: len(table), None]
            matrix = matrix - table.T @ (table / totals)
        # The sum of all gains is free: keep it at zero, and photos that share no point, too.
        scale = max(float(np.trace(matrix)) / photos, 1e-12)
        gauge = np.full((photos, photos), 1.0 / photos) + 1e-9 * np.eye(photos)
        gains = np.asarray(np.linalg.solve(matrix + scale * gauge, right), np.float64)
        without_gain = values - gains[view]
        color = np.bincount(point, weights * without_gain) / point_weight
        residual = without_gain - color[point]
        width = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weights = 1.0 / (1.0 + (residual / (2.0 * width)) ** 2)
    return np.asarray(gains)


def _affine(observations: _Observations | None, log_gain: Float64) -> list[Exposure]:
    """Gain and offset of each photo, starting from its log gain, float64 [V, 3].

    Gains and offsets of photos and colors of points are fitted in turn, by robust least squares
    with a prior on offsets.
    """
    gain, offset = np.exp(log_gain), np.zeros_like(log_gain)
    if observations is not None:
        known = np.bincount(observations.view, minlength=len(gain)) >= MIN_POINTS
        for channel in range(3):
            gains, offsets = _affine_channel(
                observations, observations.color[:, channel], gain[:, channel].copy()
            )
            gain[known, channel] = gains[known]
            offset[known, channel] = offsets[known]
    return [Exposure(tuple(a), tuple(b)) for a, b in zip(gain, offset, strict=True)]


def _affine_channel(
    observations: _Observations, values: Float64, gain: Float64
) -> tuple[Float64, Float64]:
    """Gains and offsets [V] of one channel, with zero mean of log gains and of offsets."""
    view, point, photos = observations.view, observations.point, len(gain)
    weights: Float64 = np.ones(len(values))
    offset: Float64 = np.zeros(photos)

    def sums(terms: Float64) -> Float64:
        return np.bincount(view, weights * terms, minlength=photos).astype(np.float64)

    for turn in range(AFFINE_ROUNDS):
        squares = np.bincount(point, weights * gain[view] ** 2)
        weighted = np.bincount(point, weights * gain[view] * (values - offset[view]))
        color = (weighted / squares)[point]
        residual = values - gain[view] * color - offset[view]
        width = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        if turn % 5 == 0:
            weights = 1.0 / (1.0 + (residual / (2.0 * width)) ** 2)
        # Two normal equations per photo: its gain and its offset, with the prior on the offset.
        ones = sums(np.ones_like(values)) + (width / OFFSET_DEVIATION) ** 2
        x, xx, y, xy = sums(color), sums(color**2), sums(values), sums(color * values)
        determinant = xx * ones - x**2
        is_regular = determinant > 1e-9 * ones**2
        determinant = np.where(is_regular, determinant, 1.0)
        gain = np.where(is_regular, (xy * ones - x * y) / determinant, gain)
        offset = np.where(is_regular, (xx * y - x * xy) / determinant, offset)
        gain = np.clip(gain, 1.0 / MAX_GAIN, MAX_GAIN)
        gain /= np.exp(np.log(gain).mean())
        offset -= gain * (offset.sum() / gain.sum())
    return gain, offset
