"""Pose priors: how precisely tracks determine the cameras that a joint fit optimizes.

Bundle adjustment averages over thousands of points and finds cameras to hundredths of a pixel. The
photometric loss of a fit is less precise and would move such cameras away, so cameras with tracks
get a Gaussian prior. Its information is the inverse of the covariance that bundle adjustment would
report, with points and all other cameras free, for the residuals of the tracks (Triggs et al.,
"Bundle Adjustment - A Modern Synthesis", 2000, sections 6.1 and 9).

Cameras that are not at the optimum of their tracks (for example because noise was added) are less
certain, by the length of the next step of bundle adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture import Points, View
from igsr.geometry.bundle_equations import RIDGE, Equations, gauge, without_points

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: Minimum number of points for a prior.
MIN_POINTS = 3
#: Minimum standard error of a position in a photo, pixels, however well synthetic tracks agree.
MIN_ERROR_PX = 0.05
#: Factor on standard deviations. Colors pull in every step, and mostly in one direction: with a
#: factor of 1, cameras that COLMAP had found were measurably worse after a fit.
DEVIATION_FACTOR = 0.25
#: Outliers have an error of more than this many times the median and more than this many pixels.
OUTLIER_FACTOR = 10.0
OUTLIER_PX = 4.0
#: Maximum ratio of a depth to the median, or of the median to a depth.
MAX_DEPTH_RATIO = 1e5
#: Maximum ratio of the information of a camera's best and worst known directions, in units of its
#: deviations. Of only two cameras, one direction is known by definition.
MAX_INFORMATION_RATIO = 1e7


@dataclass(frozen=True)
class PosePriors:
    """Gaussian priors of V cameras.

    Attributes:
        views: with the cameras at the mean of the priors.
        information: float64 [V, 6, 6], inverse covariance of rotation (radians) about and
            translation (world units) along x, y, z of the camera; zero without a prior. Standard
            deviations are multiplied by ``DEVIATION_FACTOR``.
        focal_information: float64 [V], inverse variance of the log focal length.
    """

    views: Sequence[View]
    information: Float64
    focal_information: Float64


def pose_priors(
    views: Sequence[View], points: Points | None, *, poses: bool, focal: str
) -> PosePriors | None:
    """Return priors from tracks, or from ``pose_evidence`` for cameras without tracks.

    Args:
        views, points, poses, focal: as ``priors_of_tracks``.

    Returns:
        None if no camera has either.
    """
    priors = priors_of_tracks(views, points, poses=poses, focal=focal)
    if not poses or all(view.pose_evidence is None for view in views):
        return priors
    if priors is None:
        priors = PosePriors(views, np.zeros((len(views), 6, 6)), np.zeros(len(views)))
    information = priors.information.copy()
    for k, view in enumerate(views):
        evidence = view.pose_evidence
        if evidence is None or information[k].any():
            continue
        if min(evidence.rotation, evidence.centre) > 0.0:
            # Without DEVIATION_FACTOR: predictions are wrong by whole deviations.
            deviations = np.repeat([np.radians(evidence.rotation), evidence.centre], 3)
            information[k] = np.diag(1.0 / deviations**2)
    return PosePriors(views, information, priors.focal_information)


def priors_of_tracks(
    views: Sequence[View], points: Points | None, *, poses: bool, focal: str
) -> PosePriors | None:
    """Return priors from the tracks of a capture.

    Args:
        views: with the cameras that were found with the tracks; observations in other photos are
            not used.
        points: of the capture, with tracks, or None.
        poses: whether poses are optimized; otherwise they count as exact.
        focal: which focal lengths are optimized: "fixed", "shared" or "per-camera".

    Returns:
        None if no camera has enough tracks.
    """
    observations = None if points is None else _observations(views, points)
    if points is None or observations is None:
        return None
    try:
        with np.errstate(all="ignore"):
            return _priors(views, points.xyz, *observations, poses, focal)
    except np.linalg.LinAlgError:
        return None  # degenerate cameras and points


def _priors(
    views: Sequence[View],
    xyz: Float64,
    view: Int64,
    point: Int64,
    xy: Float64,
    poses: bool,
    focal: str,
) -> PosePriors | None:
    count = len(views)
    has_tracks = np.bincount(view, minlength=count) > 0
    equations = _linearize(views, xyz, view, point, xy, poses, focal)
    normal = without_points(equations)
    size = equations.width - 1
    slope, error = normal[:size, size], normal[size, size]
    diagonal = np.diagonal(normal)[:size]
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = normal[:size, :size] / np.outer(scale, scale) + RIDGE * np.eye(size)
    free = np.zeros((size, 0))
    if poses:
        # Tracks leave rotation, translation and scale of the whole free, which is not asked for.
        # Cameras without tracks are left out of it, or they would loosen all others.
        free = np.zeros((size, 7))
        cameras = [one.camera for one in views]
        free[: 6 * count] = gauge(cameras) * np.repeat(has_tracks, 6)[:, None]
        free = np.linalg.qr(free * scale[:, None])[0]
    covariance = np.linalg.inv(scaled + free @ free.T) - free @ free.T
    step = -covariance @ (slope / scale) / scale
    freedom = 2 * len(point) - 3 * (equations.point.max() + 1) - size
    variance = max(MIN_ERROR_PX**2, (error + slope @ step) / max(freedom, 1))
    covariance *= DEVIATION_FACTOR**2 * variance / np.outer(scale, scale)
    covariance += np.outer(step, step)

    information, focal_information = np.zeros((count, 6, 6)), np.zeros(count)
    if poses:
        for k in np.flatnonzero(has_tracks):
            rows = slice(6 * k, 6 * k + 6)
            information[k] = _inverse(covariance[rows, rows])
    if focal == "shared":
        focal_information[:] = 1.0 / covariance[-1, -1]
    elif focal == "per-camera":
        focal_information[has_tracks] = 1.0 / np.diagonal(covariance)[-count:][has_tracks]
    is_finite = np.isfinite(information).all() and np.isfinite(focal_information).all()
    if not is_finite or focal_information.min() < 0.0:
        return None
    return PosePriors(views, information, focal_information)


def _observations(views: Sequence[View], points: Points) -> tuple[Int64, Int64, Float64] | None:
    """View, point and pixel of observations of points that at least two views show.

    Left out are points behind a camera, outliers, and views with too few of the others.
    """
    tracks = points.tracks
    if tracks is None:
        return None
    index = {view.name: k for k, view in enumerate(views)}
    view_of = np.array([index.get(name, -1) for name in tracks.names], dtype=np.int64)
    view = view_of[tracks.view]
    depth, error = np.full(len(view), -1.0), np.full(len(view), np.inf)
    with np.errstate(all="ignore"):
        for k, camera in enumerate(one.camera for one in views):
            of_view = np.flatnonzero(view == k)
            local = points.xyz[tracks.point[of_view]] @ camera.viewmat[:3, :3].T
            local += camera.viewmat[:3, 3]
            pixel = local[:, :2] / local[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
            depth[of_view] = local[:, 2]
            error[of_view] = np.linalg.norm(pixel - tracks.xy[of_view], axis=1)
    usable = (view >= 0) & (depth > 0.0) & np.isfinite(depth) & np.isfinite(error)
    if not usable.any():
        return None
    median = float(np.median(depth[usable]))
    usable &= (depth < MAX_DEPTH_RATIO * median) & (depth > median / MAX_DEPTH_RATIO)
    usable &= error <= max(OUTLIER_PX, OUTLIER_FACTOR * float(np.median(error[usable])))
    # One observation of a point per view.
    pairs = np.stack([tracks.point[usable], view[usable]], axis=1)
    first = np.unique(pairs, axis=0, return_index=True)[1]
    chosen = np.sort(np.flatnonzero(usable)[first])
    before = -1
    while len(chosen) != before:
        before = len(chosen)
        views_of_point = np.bincount(tracks.point[chosen], minlength=len(points.xyz))
        points_of_view = np.bincount(view[chosen], minlength=len(views))
        enough_views = views_of_point[tracks.point[chosen]] >= 2
        chosen = chosen[enough_views & (points_of_view[view[chosen]] >= MIN_POINTS)]
    if not len(chosen):
        return None
    return view[chosen], tracks.point[chosen], tracks.xy[chosen]


def _linearize(
    views: Sequence[View],
    xyz: Float64,
    view: Int64,
    point: Int64,
    xy: Float64,
    poses: bool,
    focal: str,
) -> Equations:
    """The equations of bundle adjustment, linearized at the cameras and points."""
    count, total = len(views), len(view)
    cameras = [one.camera for one in views]
    viewmat = np.stack([camera.viewmat for camera in cameras])[view]
    K = np.stack([camera.K for camera in cameras])[view]
    focal_px = K[:, [0, 1], [0, 1]]
    local = np.einsum("mij,mj->mi", viewmat[:, :3, :3], xyz[point]) + viewmat[:, :3, 3]
    ray = local[:, :2] / local[:, 2:]
    # Derivative of the pixel by the point in the frame of the camera, [M, 2, 3].
    by_local = np.zeros((total, 2, 3))
    by_local[:, [0, 1], [0, 1]] = 1.0
    by_local[:, :, 2] = -ray
    by_local *= (focal_px / local[:, 2:])[:, :, None]
    columns, values = [], []
    if poses:
        # A rotation w moves the point by w x local.
        by_rotation = -np.cross(by_local, local[:, None, :], axisa=2, axisb=2)
        values.append(np.concatenate([by_rotation, by_local], axis=2))
        columns.append(6 * view[:, None] + np.arange(6))
    first_focal = 6 * count * poses
    focals = {"fixed": 0, "shared": 1, "per-camera": count}[focal]
    if focals:
        values.append((ray * focal_px)[:, :, None])
        columns.append((first_focal + (view if focals > 1 else 0 * view))[:, None])
    width = first_focal + focals + 1
    values.append((ray * focal_px + K[:, :2, 2] - xy)[:, :, None])
    columns.append(np.full((total, 1), width - 1))
    return Equations(
        np.unique(point, return_inverse=True)[1],
        np.concatenate(columns, axis=1),
        np.concatenate(values, axis=2),
        by_local @ viewmat[:, :3, :3],
        width,
    )


def _inverse(covariance: Float64) -> Float64:
    """Symmetric inverse of a covariance whose rows have different units."""
    unit = np.sqrt(np.diagonal(covariance))
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    variances = np.maximum(variances, variances[-1] / MAX_INFORMATION_RATIO)
    return np.asarray((axes / variances) @ axes.T / np.outer(unit, unit))
