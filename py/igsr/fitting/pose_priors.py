"""Pose priors: how well tracks know the cameras, which joint fits then keep near them.

Bundle adjustment finds cameras to hundredths of a pixel, since it averages over thousands of places
that several photos show. The colors of a fit are no match for that: left to themselves, they move
such cameras away. So cameras that have tracks get a Gaussian prior from these. Its information is
the inverse of the covariance that bundle adjustment would report, points and all other cameras
free, for the errors that the tracks are seen to have (Triggs et al., "Bundle Adjustment - A Modern
Synthesis", 2000, sections 6.1 and 9).

Cameras that are not where their tracks have them (noise was added, or something else moved them
since) are known less well than that: by how far the next step of bundle adjustment would move them.
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

#: A camera that sees fewer points has no prior.
FEWEST = 3
#: Pixels; no place in a photo is known better, however well synthetic tracks agree.
LEAST_ERROR = 0.05
#: Fraction of a standard deviation that is left to the colors. They pull all the time, and mostly
#: one way: with a whole one, cameras that COLMAP had found were measurably worse after a fit.
LEFT_OPEN = 0.25
#: Observations further off than so many times the median, and by more than so many pixels, are
#: outliers: squared, one of them would outweigh all others.
OUTLIER, OUTLIER_PIXELS = 10.0, 4.0
#: Depths beyond this many times the median, or below its inverse, are no places that cameras see.
DEEPEST = 1e5
#: What is known of a camera is limited to this many times what is known least of it (in units of
#: its own deviations): of only two cameras, one direction is known by definition.
MOST_KNOWN = 1e7


@dataclass(frozen=True)
class PosePriors:
    """Gaussian priors of V cameras: where they were found, and how well they are known.

    Attributes:
        views: with these cameras.
        information: float64 [V, 6, 6], inverse of the covariance of rotation (radians) about and
            translation (world units) along x, y, z of the camera, with ``LEFT_OPEN`` of the
            standard deviations that the tracks leave; zero where nothing is known.
        focal_information: float64 [V], inverse of the variance of the focal length's logarithm.
    """

    views: Sequence[View]
    information: Float64
    focal_information: Float64


def pose_priors(
    views: Sequence[View], points: Points | None, *, poses: bool, focal: str
) -> PosePriors | None:
    """What is known of the cameras that are to be optimized.

    A camera with tracks is known by these, another by its ``pose_evidence``.

    Args:
        views, points, poses, focal: as ``priors_of_tracks``.

    Returns:
        None where nothing is known.
    """
    priors = priors_of_tracks(views, points, poses=poses, focal=focal)
    if not poses or all(view.pose_evidence is None for view in views):
        return priors
    if priors is None:
        priors = PosePriors(views, np.zeros((len(views), 6, 6)), np.zeros(len(views)))
    information = priors.information.copy()
    for k, view in enumerate(views):
        known = view.pose_evidence
        if known is None or information[k].any() or not min(known.rotation, known.center) > 0.0:
            continue
        # Not ``LEFT_OPEN`` of it: a prediction is wrong by all of it, and colors may mend it.
        deviations = np.repeat([np.radians(known.rotation), known.center], 3)
        information[k] = np.diag(1.0 / deviations**2)
    return PosePriors(views, information, priors.focal_information)


def priors_of_tracks(
    views: Sequence[View], points: Points | None, *, poses: bool, focal: str
) -> PosePriors | None:
    """What the tracks of a capture say about the cameras that are to be optimized.

    Args:
        views: with the cameras that were found with the tracks; what other photos saw is left out.
        points: of the capture; without tracks, nothing is known.
        poses: whether poses are optimized; what is not is taken to be exact.
        focal: which focal lengths are optimized: "fixed", "shared" or "per-camera".

    Returns:
        None where no camera has enough tracks.
    """
    count = len(views)
    seen = None if points is None else _seen_by(views, points)
    if points is None or seen is None:
        return None
    view, point, xy = seen
    enough = np.bincount(view, minlength=count) > 0
    try:
        with np.errstate(all="ignore"):
            return _priors(views, points.xyz, view, point, xy, enough, poses, focal)
    except np.linalg.LinAlgError:
        return None  # places and points that no camera can have seen say nothing


def _priors(
    views: Sequence[View],
    xyz: Float64,
    view: Int64,
    point: Int64,
    xy: Float64,
    enough: npt.NDArray[np.bool_],
    poses: bool,
    focal: str,
) -> PosePriors | None:
    count = len(views)
    equations = _linearised(views, xyz, view, point, xy, poses, focal)
    normal = without_points(equations)
    size = equations.width - 1
    slope, error = normal[:size, size], normal[size, size]
    known = np.diagonal(normal)[:size]
    scale = np.sqrt(np.where(known > 0.0, known, 1.0))
    scaled = normal[:size, :size] / np.outer(scale, scale) + RIDGE * np.eye(size)
    unseen = np.zeros((size, 0))
    if poses:
        # Turning, moving and scaling all together is seen by no photo, and is not what is asked.
        unseen = np.zeros((size, 7))
        # Cameras without tracks have no part in it: they would loosen all others.
        unseen[: 6 * count] = gauge([view.camera for view in views]) * np.repeat(enough, 6)[:, None]
        unseen = np.linalg.qr(unseen * scale[:, None])[0]
    covariance = np.linalg.inv(scaled + unseen @ unseen.T) - unseen @ unseen.T
    step = -covariance @ (slope / scale) / scale
    freedom = 2 * len(point) - 3 * (equations.point.max() + 1) - size
    variance = max(LEAST_ERROR**2, (error + slope @ step) / max(freedom, 1))
    covariance *= LEFT_OPEN**2 * variance / np.outer(scale, scale)
    covariance += np.outer(step, step)

    information, of_focal = np.zeros((count, 6, 6)), np.zeros(count)
    for k in np.flatnonzero(enough):
        if poses:
            rows = slice(6 * k, 6 * k + 6)
            information[k] = _inverse(covariance[rows, rows])
    if focal == "shared":
        of_focal[:] = 1.0 / covariance[-1, -1]
    elif focal == "per-camera":
        of_focal[enough] = 1.0 / np.diagonal(covariance)[-count:][enough]
    if not (
        np.isfinite(information).all() and np.isfinite(of_focal).all() and of_focal.min() >= 0.0
    ):
        return None
    return PosePriors(views, information, of_focal)


def _seen_by(
    views: Sequence[View], points: Points
) -> tuple[Int64, Int64, npt.NDArray[np.float64]] | None:
    """View, point and place of observations of points that at least two of the views see.

    Left out are what stands behind a camera, what is far off, and views with too few of the rest.
    """
    tracks = points.tracks
    if tracks is None:
        return None
    index = {view.name: k for k, view in enumerate(views)}
    view_of = np.array([index.get(name, -1) for name in tracks.names], dtype=np.int64)
    view = view_of[tracks.view]
    depth, off = np.full(len(view), -1.0), np.full(len(view), np.inf)
    with np.errstate(all="ignore"):
        for k, one in enumerate(views):
            mine = np.flatnonzero(view == k)
            camera = one.camera
            local = points.xyz[tracks.point[mine]] @ camera.viewmat[:3, :3].T
            local += camera.viewmat[:3, 3]
            place = local[:, :2] / local[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
            depth[mine] = local[:, 2]
            off[mine] = np.linalg.norm(place - tracks.xy[mine], axis=1)
    usable = (view >= 0) & (depth > 0.0) & np.isfinite(depth) & np.isfinite(off)
    if not usable.any():
        return None
    middle = float(np.median(depth[usable]))
    usable &= (depth < DEEPEST * middle) & (depth > middle / DEEPEST)
    usable &= off <= max(OUTLIER_PIXELS, OUTLIER * float(np.median(off[usable])))
    # A point that one photo sees says nothing about it; one that a photo sees twice is no point.
    pairs = np.unique(
        np.stack([tracks.point[usable], view[usable]], axis=1), axis=0, return_index=True
    )[1]
    chosen = np.sort(np.flatnonzero(usable)[pairs])
    before = -1
    while len(chosen) != before:
        before = len(chosen)
        seen_by = np.bincount(tracks.point[chosen], minlength=len(points.xyz))
        sees = np.bincount(view[chosen], minlength=len(views))
        keep = (seen_by[tracks.point[chosen]] >= 2) & (sees[view[chosen]] >= FEWEST)
        chosen = chosen[keep]
    if not len(chosen):
        return None
    return view[chosen], tracks.point[chosen], tracks.xy[chosen]


def _linearised(
    views: Sequence[View],
    xyz: Float64,
    view: Int64,
    point: Int64,
    xy: Float64,
    poses: bool,
    focal: str,
) -> Equations:
    """The equations of bundle adjustment at where cameras and points are."""
    count, total = len(views), len(view)
    cameras = [one.camera for one in views]
    viewmat = np.stack([camera.viewmat for camera in cameras])[view]
    K = np.stack([camera.K for camera in cameras])[view]
    focal_pixels = K[:, [0, 1], [0, 1]]
    local = np.einsum("mij,mj->mi", viewmat[:, :3, :3], xyz[point]) + viewmat[:, :3, 3]
    ray = local[:, :2] / local[:, 2:]
    # How the place in the photo follows the point in the camera's frame: [M, 2, 3].
    of_local = np.zeros((total, 2, 3))
    of_local[:, [0, 1], [0, 1]] = 1.0
    of_local[:, :, 2] = -ray
    of_local *= (focal_pixels / local[:, 2:])[:, :, None]
    columns, values = [], []
    if poses:
        # A turn w moves the point by w x local.
        turns = np.cross(of_local, local[:, None, :], axisa=2, axisb=2)
        values.append(np.concatenate([-turns, of_local], axis=2))
        columns.append(6 * view[:, None] + np.arange(6))
    before = 6 * count * poses
    focals = {"fixed": 0, "shared": 1, "per-camera": count}[focal]
    if focals:
        values.append((ray * focal_pixels)[:, :, None])
        columns.append((before + (view if focals > 1 else 0 * view))[:, None])
    width = before + focals + 1
    values.append((ray * focal_pixels + K[:, :2, 2] - xy)[:, :, None])
    columns.append(np.full((total, 1), width - 1))
    return Equations(
        np.unique(point, return_inverse=True)[1],
        np.concatenate(columns, axis=1),
        np.concatenate(values, axis=2),
        of_local @ viewmat[:, :3, :3],
        width,
    )


def _inverse(covariance: Float64) -> Float64:
    """The symmetric inverse of a covariance whose entries have units of their own."""
    unit = np.sqrt(np.diagonal(covariance))
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    variances = np.maximum(variances, variances[-1] / MOST_KNOWN)
    return np.asarray((axes / variances) @ axes.T / np.outer(unit, unit))
