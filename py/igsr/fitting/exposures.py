"""Where the exposures of photos start in a fit, and whether they are fitted at all.

Photos that see the same points tell how bright they are to each other: the logarithm of a point's
color in a photo is that of the photo's gain plus that of the point. Gains are their robust least
squares solution (M-estimator with Cauchy's weights, iteratively reweighted). How far it is to be
believed says a delete-one-group jackknife (Efron and Stein 1981) over groups of points that lie
together, since what is near changes alike: highlights, vignetting, shadows.

Exposures are fitted ("auto") where photos differ in gain by ``LEAST_SPREAD`` or more from those
that they share most points with, beyond what the jackknife leaves open. A gain that drifts from
photo to photo is no reason: splats follow it with the direction, and photos between have it, too.
Where the capture has no tracks, EXIF decides, if all photos have it; without either, exposures are
not fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture import Exposure, Points, PseudoView, View
from igsr.fitting.settings import ExposureMode

Float64 = npt.NDArray[np.float64]

#: Spread of the photos' log gains from which on exposures are fitted: a sixth of a stop. A photo is
#: compared with so many others.
LEAST_SPREAD, NEAREST = 0.05, 2
#: Encoded brightness (sRGB) that one stop more of light makes: a power of 1/2.2 of it.
LOG_GAIN_OF_STOP = float(np.log(2.0) / 2.2)
#: A point's color in a photo is the mean of so many pixels on a side.
PATCH = 5
#: Patches with darker or brighter pixels than these say little of gains: noise, and clipping.
DARK, BRIGHT = 10, 250
#: Fewest points that a photo must share with others for its gain to be believed.
LEAST_POINTS = 30
#: Groups of the jackknife.
GROUPS = 8
#: A start whose log gain has this standard error is pulled to with a weight of 1, others with its
#: square over theirs, at most the second.
UNIT_ERROR, MOST_PULL = 0.03, 100.0
#: Standard errors of log gains by EXIF, and of those that a view brings from a fit.
EXIF_ERROR, FITTED_ERROR = 0.1, 0.02
#: Points that are held in one table.
TABLE_POINTS = 4096
#: Rounds of reweighting.
ROUNDS = 12
#: Turns in which photos and points are fitted; an offset that is likely; and the largest gain.
AFFINE_ROUNDS, LIKELY_OFFSET, MOST_GAIN = 50, 0.05, 16.0


@dataclass(frozen=True, eq=False)
class RelativeGains:
    """How bright photos are to each other.

    Attributes:
        log_gain: float64 [V, 3], with a mean of zero over the photos that are known.
        error: float64 [V, 3], its standard error; infinite where nothing is known.
        spread: root mean square of what a photo's log gain differs from those of the photos that it
            shares most with, over the square root of 2, less what errors explain: what it would be
            if each photo's were independent of the others'.
    """

    log_gain: Float64
    error: Float64
    spread: float


@dataclass(frozen=True, eq=False)
class StartingExposures:
    """Where exposures of V views start in a fit.

    Attributes:
        exposures: one for each view; None for views with the splats' own colors.
        pulls: float64 [V], how much each is pulled back to its start: the loss grows by this times
            half the squares of what log gains and offsets are off. A slope of the loss of 0.01,
            which a poor render may make, so moves them by 0.01 / pull at most.
    """

    exposures: list[Exposure | None]
    pulls: Float64


def starting_exposures(
    views: Sequence[View], points: Points | None, mode: ExposureMode
) -> StartingExposures | None:
    """Where exposures of views start, or None where they are not fitted.

    Views that bring an exposure start from it. Pseudo-views have none, but the splats' own colors.

    Args:
        views: to fit.
        points: of the capture.
        mode: "auto", "on" or "off".
    """
    if mode == "off":
        return None
    photos = [view for view in views if not isinstance(view, PseudoView)]
    if any(view.exposure is not None for view in photos):
        known = [view.exposure or Exposure() for view in photos]
        error = np.full(len(photos), FITTED_ERROR)
    else:
        observed = _observed(photos, points)
        gains = _gains(observed, len(photos)) or gains_by_exif(photos)
        if mode == "auto" and (gains is None or gains.spread < LEAST_SPREAD):
            return None
        log_gain = np.zeros((len(photos), 3)) if gains is None else gains.log_gain
        known = _affine(observed, log_gain)
        error = np.full(len(photos), np.inf)
        if gains is not None:
            error = np.sqrt(np.mean(gains.error**2, axis=1))
    pull = np.minimum(MOST_PULL, (UNIT_ERROR / np.maximum(error, 1e-9)) ** 2)
    each = iter(zip(known, pull, strict=True))
    rows = [(None, 0.0) if isinstance(view, PseudoView) else next(each) for view in views]
    return StartingExposures([one for one, _ in rows], np.array([by for _, by in rows]))


def gains_by_exif(photos: Sequence[View]) -> RelativeGains | None:
    """Gains by how much light photos took; None where one of them does not tell."""
    stops = [photo.exposure_value for photo in photos]
    if not stops or any(value is None for value in stops):
        return None
    log_gain = LOG_GAIN_OF_STOP * np.array(stops, np.float64)
    rows = np.repeat((log_gain - log_gain.mean())[:, None], 3, axis=1)
    return RelativeGains(rows, np.full_like(rows, EXIF_ERROR), float(log_gain.std()))


def gains_by_points(photos: Sequence[View], points: Points | None) -> RelativeGains | None:
    """Gains by the colors of points that photos share; None where there are no tracks of them.

    Args:
        photos: V photos.
        points: with tracks in their pixels.
    """
    return _gains(_observed(photos, points), len(photos))


@dataclass(frozen=True, eq=False)
class _Observed:
    """Observations of points that tell of gains.

    Attributes:
        view: int64 [M], photo of each.
        point: int64 [M], its point, from 0 without gaps; at least two observations have it.
        color: float64 [M, 3], mean color there, in (0, 1].
        group: int64 [M], of the jackknife.
    """

    view: npt.NDArray[np.int64]
    point: npt.NDArray[np.int64]
    color: Float64
    group: npt.NDArray[np.int64]


def _gains(observed: _Observed | None, photos: int) -> RelativeGains | None:
    """See ``gains_by_points``."""
    if observed is None:
        return None
    view, point, log_color = observed.view, observed.point, np.log(observed.color)
    whole, count = _solved(view, point, log_color, photos)
    others = [np.flatnonzero(observed.group != k) for k in range(GROUPS)]
    parts = np.stack([_solved(view[k], point[k], log_color[k], photos)[0] for k in others])
    error = _jackknifed(parts)
    believed = count >= LEAST_POINTS
    if believed.sum() < 2:
        return None
    spread = _spread(observed, whole, parts, believed)
    log_gain = np.where(believed[:, None], whole - whole[believed].mean(axis=0), 0.0)
    return RelativeGains(log_gain, np.where(believed[:, None], error, np.inf), spread)


def _jackknifed(parts: Float64) -> Float64:
    """Standard error of a value by what it is without each group, [GROUPS, ...]."""
    squares = np.sum((parts - parts.mean(axis=0)) ** 2, axis=0)
    return np.asarray(np.sqrt((GROUPS - 1) / GROUPS * squares))


def _spread(
    observed: _Observed, gains: Float64, parts: Float64, believed: npt.NDArray[np.bool_]
) -> float:
    """``RelativeGains.spread`` of log gains [V, 3], which are ``parts`` without each group."""
    shared = _shared_points(observed, len(gains))
    shared[~believed] = shared[:, ~believed] = 0.0
    square, number = 0.0, 0
    for photo in np.flatnonzero(believed):
        for other in np.argsort(-shared[photo], kind="stable")[:NEAREST]:
            if shared[photo, other] > 0.0:
                error = _jackknifed(parts[:, photo] - parts[:, other])
                square += float(np.mean((gains[photo] - gains[other]) ** 2 - error**2))
                number += 1
    return float(np.sqrt(max(0.0, square / max(number, 1) / 2.0)))


def _shared_points(observed: _Observed, photos: int) -> Float64:
    """How many points each two photos share, float64 [V, V]; 0 for a photo and itself."""
    shared = np.zeros((photos, photos))
    for seen in _tables(observed.view, observed.point, np.ones(len(observed.view)), photos):
        shared += (seen > 0.0).astype(np.float64).T @ (seen > 0.0)
    np.fill_diagonal(shared, 0.0)
    return shared


def _tables(
    view: npt.NDArray[np.int64], point: npt.NDArray[np.int64], values: Float64, photos: int
) -> Iterator[Float64]:
    """Values by point and photo, [P', V], for some thousand points at a time."""
    for start in range(0, int(point.max()) + 1, TABLE_POINTS):
        rows = np.flatnonzero((point >= start) & (point < start + TABLE_POINTS))
        table = np.zeros((min(TABLE_POINTS, int(point.max()) + 1 - start), photos))
        np.add.at(table, (point[rows] - start, view[rows]), values[rows])
        yield table


def _observed(photos: Sequence[View], points: Points | None) -> _Observed | None:
    """What photos show of points that they share; None where that is nothing."""
    if points is None or points.tracks is None or len(photos) < 2:
        return None
    tracks = points.tracks
    index = {name: k for k, name in enumerate(tracks.names)}
    views, seen, colors = [], [], []
    for k, photo in enumerate(photos):
        mine = np.flatnonzero(tracks.view == index.get(photo.name, -1))
        patches, usable = _patches(photo, tracks.xy[mine])
        views.append(np.full(int(usable.sum()), k))
        seen.append(tracks.point[mine][usable])
        colors.append(patches[usable])
    view, point, color = np.concatenate(views), np.concatenate(seen), np.concatenate(colors)
    shared = np.bincount(point, minlength=len(points.xyz))[point] >= 2
    view, point, color = view[shared], point[shared], color[shared]
    if not len(view):
        return None
    group = _groups(points.xyz, point)
    _, point = np.unique(point, return_inverse=True)
    return _Observed(view, point, color, group)


def _patches(photo: View, xy: Float64) -> tuple[Float64, npt.NDArray[np.bool_]]:
    """Mean colors [M, 3] in (0, 1] around pixel coordinates, and which of them may be used."""
    height, width = photo.image.shape[:2]
    half = PATCH // 2
    column, row = np.floor(xy).astype(np.int64).T
    usable = (column >= half) & (row >= half) & (column < width - half) & (row < height - half)
    column, row = np.where(usable, column, half), np.where(usable, row, half)
    if min(height, width) < PATCH:
        return np.ones((len(xy), 3)), np.zeros(len(xy), np.bool_)
    offsets = np.arange(PATCH) - half
    rows, columns = row[:, None, None] + offsets[:, None], column[:, None, None] + offsets
    pixels = photo.image[rows, columns]
    colors = pixels[..., :3]
    usable &= (colors.min(axis=(1, 2, 3)) >= DARK) & (colors.max(axis=(1, 2, 3)) <= BRIGHT)
    if photo.image.shape[2] == 4:
        usable &= pixels[..., 3].min(axis=(1, 2)) == 255
    if photo.mask is not None:
        usable &= photo.mask[rows, columns].all(axis=(1, 2))
    means = colors.mean(axis=(1, 2), dtype=np.float64) / 255.0
    return np.maximum(means, 1.0 / 255.0), usable


def _groups(xyz: Float64, point: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The group of each observation: its point's place along the points' longest axis."""
    used = np.unique(point)
    centred = xyz[used] - np.median(xyz[used], axis=0)
    # Few points are far off; those do not decide the axis.
    near = np.linalg.norm(centred, axis=1)
    inner = centred[near <= np.quantile(near, 0.9)]
    axis = np.linalg.svd(inner, full_matrices=False)[2][0]
    order = np.argsort(np.argsort(centred @ axis))
    group = np.zeros(len(xyz), np.int64)
    group[used] = order * GROUPS // len(used)
    return group[point]


def _solved(
    view: npt.NDArray[np.int64], point: npt.NDArray[np.int64], log_color: Float64, count: int
) -> tuple[Float64, npt.NDArray[np.int64]]:
    """Log gains [V, 3] with a mean of zero, and how many shared points each photo has."""
    seen = np.bincount(point)
    kept = seen[point] >= 2
    view, point, log_color = view[kept], point[kept], log_color[kept]
    _, point = np.unique(point, return_inverse=True)
    seen = np.bincount(view, minlength=count)
    gains = np.zeros((count, 3))
    if not len(view):
        return gains, seen
    for channel in range(3):
        gains[:, channel] = _solved_channel(view, point, log_color[:, channel], count)
    return gains, seen


def _solved_channel(
    view: npt.NDArray[np.int64], point: npt.NDArray[np.int64], values: Float64, count: int
) -> Float64:
    """Log gains [V] of one channel; photos that share nothing keep zero."""
    weights: Float64 = np.ones(len(values))
    gains: Float64 = np.zeros(count)
    for _ in range(ROUNDS):
        # Normal equations with the points' colors eliminated.
        of_point = np.bincount(point, weights)
        color = np.bincount(point, weights * values) / of_point
        right = np.bincount(view, weights * (values - color[point]), minlength=count)
        matrix: Float64 = np.diag(np.bincount(view, weights, minlength=count)).astype(np.float64)
        for number, table in enumerate(_tables(view, point, weights, count)):
            totals = of_point[number * TABLE_POINTS :][: len(table), None]
            matrix = matrix - table.T @ (table / totals)
        # All gains may grow together: their mean stays zero. What shares nothing stays zero, too.
        scale = max(float(np.trace(matrix)) / count, 1e-12)
        together = np.full((count, count), 1.0 / count) + 1e-9 * np.eye(count)
        gains = np.asarray(np.linalg.solve(matrix + scale * together, right), np.float64)
        of_photo = values - gains[view]
        color = np.bincount(point, weights * of_photo) / of_point
        residual = of_photo - color[point]
        width = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        weights = 1.0 / (1.0 + (residual / (2.0 * width)) ** 2)
    return np.asarray(gains)


def _affine(observed: _Observed | None, log_gain: Float64) -> list[Exposure]:
    """Gain and offset of each photo, from its gain alone.

    Photos' gains and offsets and points' colors are fitted in turn, by robust least squares; an
    offset must be told by the points against a pull to none.

    Args:
        observed: what the points tell, if anything.
        log_gain: float64 [V, 3].
    """
    gain, offset = np.exp(log_gain), np.zeros_like(log_gain)
    if observed is not None:
        believed = np.bincount(observed.view, minlength=len(gain)) >= LEAST_POINTS
        for channel in range(3):
            start = gain[:, channel].copy()
            found = _affine_channel(observed, observed.color[:, channel], start)
            for values, one in zip((gain, offset), found, strict=True):
                values[believed, channel] = one[believed]
    return [Exposure(tuple(one), tuple(by)) for one, by in zip(gain, offset, strict=True)]


def _affine_channel(observed: _Observed, values: Float64, gain: Float64) -> tuple[Float64, Float64]:
    """Gains and offsets [V] of one channel, with means of log gain and of offset of zero."""
    view, point, count = observed.view, observed.point, len(gain)
    weights: Float64 = np.ones(len(values))
    offset: Float64 = np.zeros(count)

    def sums(terms: Float64) -> Float64:
        return np.bincount(view, weights * terms, minlength=count).astype(np.float64)

    for turn in range(AFFINE_ROUNDS):
        squares = np.bincount(point, weights * gain[view] ** 2)
        color = (np.bincount(point, weights * gain[view] * (values - offset[view])) / squares)[
            point
        ]
        residual = values - gain[view] * color - offset[view]
        width = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
        if turn % 5 == 0:
            weights = 1.0 / (1.0 + (residual / (2.0 * width)) ** 2)
        # Two normal equations for each photo, with the pull on the offset.
        one = sums(np.ones_like(values)) + (width / LIKELY_OFFSET) ** 2
        by, by_by, to, by_to = sums(color), sums(color**2), sums(values), sums(color * values)
        determinant = by_by * one - by**2
        told = determinant > 1e-9 * one**2
        determinant = np.where(told, determinant, 1.0)
        gain = np.where(told, (by_to * one - by * to) / determinant, gain)
        offset = np.where(told, (by_by * to - by * by_to) / determinant, offset)
        gain = np.clip(gain, 1.0 / MOST_GAIN, MOST_GAIN)
        gain /= np.exp(np.log(gain).mean())
        offset -= gain * (offset.sum() / gain.sum())
    return gain, offset
