"""Bundle adjustment with a network's prediction as a prior on cameras and depths.

Features decide if they determine the cameras, otherwise the prediction does: for example, two
photos alone determine no distance to a third one. Cauchy losses limit the influence of outliers, so
one wrong camera or depth map moves no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.geometry.bundle_equations import (
    RIDGE,
    Equations,
    gauge,
    steps_of_points,
    without_points,
)
from igsr.geometry.pose_errors import rotation_angle

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: Standard deviations of predictions: the logarithms of a photo's scale of depths, of a depth, and
#: of a focal length.
SCALE_DEVIATION = 0.1
DEPTH_DEVIATION = 0.05
FOCAL_DEVIATION = 0.05
#: Effective number of independent depths of a photo, since neighboring depths have similar errors.
INDEPENDENT_DEPTHS = 20
#: Maximum number of steps, and the relative decrease of the cost that ends them.
MAX_STEPS = 30
TOLERANCE = 1e-5
#: Levenberg-Marquardt damping: the first one, the factor of changes, and the maximum.
FIRST_DAMPING = 1e-4
DAMPING_FACTOR = 10.0
MAX_DAMPING = 1e6
#: Minimum standard deviation of an observation, pixels.
MIN_DEVIATION_PX = 0.05


@dataclass(frozen=True)
class Spread:
    """Standard deviations of a network's cameras."""

    rotation: float  # radians
    center: float  # world units


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of points in photos."""

    view: Int64  # [M], index of the photo's camera
    point: Int64  # [M], index of the point; every point is observed
    xy: Float64  # [M, 2], pixels, without lens distortion
    depth: Float64  # [M], predicted z-depth, world units; NaN if there is none


@dataclass(frozen=True, eq=False)
class Bundle:
    """V cameras and P points."""

    cameras: Sequence[Camera]  # with one focal length for both directions
    lenses: Int64  # [V]: cameras of one number share their focal length
    points: Float64  # [P, 3], world frame
    scales: Float64  # [V], logarithms of the factors that correct each photo's predicted depths

    @property
    def log_focals(self) -> Float64:
        """Logarithms of the focal lengths [G]."""
        focals = np.zeros(int(self.lenses.max()) + 1)
        for lens, camera in zip(self.lenses, self.cameras, strict=True):
            focals[lens] = np.log(camera.K[0, 0])
        return focals


def adjusted_bundle(
    bundle: Bundle,
    seen: Observations,
    predicted: Sequence[Camera | None],
    spread: Spread,
    pixels: float,
) -> Bundle:
    """Fit a bundle to observations and prediction, each with a robust loss.

    Args:
        bundle: initial.
        seen: of its points by its cameras.
        predicted: V cameras in the bundle's world, or None.
        spread: of the predicted cameras.
        pixels: scale of the loss of observations.
    """
    problem = _Problem(seen, predicted, spread, pixels, bundle.log_focals)
    damping, cost = FIRST_DAMPING, problem.cost(bundle)
    for _ in range(MAX_STEPS):
        equations, prior = problem.linearized(bundle)
        before = cost
        while damping < MAX_DAMPING:
            moved = _stepped(bundle, equations, prior, damping)
            cost = before if moved is None else problem.cost(moved)
            if moved is not None and cost < before:
                bundle, damping = moved, damping / DAMPING_FACTOR
                break
            damping *= DAMPING_FACTOR
        if not cost < (1.0 - TOLERANCE) * before:
            break
    return bundle


def covariances(
    bundle: Bundle, seen: Observations, predicted: Sequence[Camera | None], spread: Spread
) -> Float64:
    """Covariances [V, 6, 6] of rotation (radians) about and translation along the cameras' axes.

    Rotation, translation and scale of the world are left out, since no photo shows them.
    """
    problem = _Problem(seen, predicted, spread, 1.0, bundle.log_focals)
    equations, prior = problem.linearized(bundle)
    # Deviations of observations are estimated; the prediction's are known.
    for rows in (equations.value[:, :2], equations.of_point[:, :2]):
        rows /= problem.deviation(bundle)
    normal = (without_points(equations) + prior)[:-1, :-1]
    count = len(bundle.cameras)
    known = np.diagonal(normal)
    scale = np.sqrt(np.where(known > 0.0, known, 1.0))
    scaled = normal / np.outer(scale, scale) + RIDGE * np.eye(len(normal))
    unseen = np.zeros((len(normal), 7))
    unseen[: 6 * count] = gauge(bundle.cameras)
    unseen = np.linalg.qr(unseen * scale[:, None])[0]
    covariance = np.linalg.inv(scaled + unseen @ unseen.T) - unseen @ unseen.T
    covariance /= np.outer(scale, scale)
    return np.stack([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])


def spread_of(predicted: Sequence[Camera], true: Sequence[Camera]) -> tuple[float, float]:
    """Median errors per axis of predicted cameras: radians, and world units."""
    turns = [
        np.radians(rotation_angle(a.viewmat[:3, :3] @ b.viewmat[:3, :3].T))
        for a, b in zip(predicted, true, strict=True)
    ]
    moves = [np.linalg.norm(a.center - b.center) for a, b in zip(predicted, true, strict=True)]
    return float(np.median(turns)) / np.sqrt(3.0), float(np.median(moves)) / np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The cost. Parameters: 6 per camera, then focal lengths, then scales of depths."""

    seen: Observations
    predicted: Sequence[Camera | None]
    spread: Spread
    pixels: float
    log_focals: Float64  # predicted

    @cached_property
    def depth_deviations(self) -> Float64:
        """Standard deviations [M] of the logarithms of depths, as if they were independent."""
        known = np.isfinite(self.seen.depth)
        of_photo = np.bincount(self.seen.view, known)[self.seen.view]
        return np.asarray(DEPTH_DEVIATION * np.sqrt(np.maximum(of_photo / INDEPENDENT_DEPTHS, 1.0)))

    def cost(self, bundle: Bundle) -> float:
        errors, depth_errors, _ = self._errors(bundle)
        if not np.isfinite(errors).all():
            return np.inf
        cost = self.pixels**2 * np.log1p((errors**2).sum(axis=1) / self.pixels**2).sum()
        cost += np.log1p(depth_errors**2).sum()
        for camera, predicted in zip(bundle.cameras, self.predicted, strict=True):
            if predicted is not None:
                cost += 6.0 * np.log1p((self._camera_error(camera, predicted) ** 2).sum() / 6.0)
        cost += (((bundle.log_focals - self.log_focals) / FOCAL_DEVIATION) ** 2).sum()
        return float(cost + ((bundle.scales / SCALE_DEVIATION) ** 2).sum())

    def deviation(self, bundle: Bundle) -> float:
        """Robust standard deviation of observations, pixels."""
        errors = np.linalg.norm(self._errors(bundle)[0], axis=1)
        # The median of distances in the plane is 1.18 standard deviations.
        return max(MIN_DEVIATION_PX, float(np.median(errors)) / 1.18)

    def linearized(self, bundle: Bundle) -> tuple[Equations, Float64]:
        """Equations of the observations, and normal equations of the prior."""
        seen, count = self.seen, len(bundle.cameras)
        errors, depth_errors, local = self._errors(bundle)
        rotation = np.stack([one.viewmat[:3, :3] for one in bundle.cameras])[seen.view]
        focal = np.exp(bundle.log_focals)[bundle.lenses][seen.view]
        lenses = int(bundle.lenses.max()) + 1
        ray = local[:, :2] / local[:, 2:]
        of_local = np.zeros((len(local), 3, 3))
        of_local[:, [0, 1], [0, 1]] = 1.0
        of_local[:, :2, 2] = -ray
        of_local[:, :2] *= (focal / local[:, 2])[:, None, None]
        known, unit = np.isfinite(seen.depth), self.depth_deviations
        of_local[:, 2, 2] = np.where(known, 1.0 / (local[:, 2] * unit), 0.0)
        value = np.zeros((len(local), 3, 9))
        value[:, :, :3] = -np.cross(of_local, local[:, None, :], axisa=2, axisb=2)
        value[:, :, 3:6] = of_local
        value[:, :2, 6] = ray * focal[:, None]
        value[:, 2, 7] = np.where(known, -1.0 / unit, 0.0)
        value[:, :2, 8], value[:, 2, 8] = errors, depth_errors
        weight = np.stack(
            [
                *[1.0 / (1.0 + (errors**2).sum(axis=1) / self.pixels**2)] * 2,
                1.0 / (1.0 + depth_errors**2),
            ],
            axis=1,
        )
        value *= np.sqrt(weight)[:, :, None]
        width = 6 * count + lenses + count + 1
        column = np.concatenate(
            [
                6 * seen.view[:, None] + np.arange(6),
                (6 * count + bundle.lenses[seen.view])[:, None],
                (6 * count + lenses + seen.view)[:, None],
                np.full((len(local), 1), width - 1),
            ],
            axis=1,
        )
        of_point = (of_local @ rotation) * np.sqrt(weight)[:, :, None]
        return Equations(seen.point, column, value, of_point, width), self._prior(bundle, width)

    def _prior(self, bundle: Bundle, width: int) -> Float64:
        normal = np.zeros((width, width))
        count = len(bundle.cameras)
        for k, (camera, predicted) in enumerate(zip(bundle.cameras, self.predicted, strict=True)):
            if predicted is None:
                continue
            rows = np.zeros((6, width))
            error = self._camera_error(camera, predicted)
            rows[:3, 6 * k : 6 * k + 3] = np.eye(3) / self.spread.rotation
            # The center moves against the translation, along the camera's axes.
            rows[3:, 6 * k + 3 : 6 * k + 6] = -camera.viewmat[:3, :3].T / self.spread.center
            rows[:, -1] = error
            normal += rows.T @ rows / (1.0 + (error**2).sum() / 6.0)
        begin = 6 * count
        unit = np.concatenate(
            [np.full(len(self.log_focals), FOCAL_DEVIATION), np.full(count, SCALE_DEVIATION)]
        )
        error = np.concatenate([bundle.log_focals - self.log_focals, bundle.scales]) / unit
        at = np.arange(begin, begin + len(error))
        normal[at, at] += 1.0 / unit**2
        normal[at, -1] += error / unit
        normal[-1, at] += error / unit
        return normal

    def _camera_error(self, camera: Camera, predicted: Camera) -> Float64:
        """Difference of a camera to the predicted one [6], in standard deviations."""
        turn = _rotation_vector(camera.viewmat[:3, :3] @ predicted.viewmat[:3, :3].T)
        move = camera.center - predicted.center
        return np.concatenate([turn / self.spread.rotation, move / self.spread.center])

    def _errors(self, bundle: Bundle) -> tuple[Float64, Float64, Float64]:
        """Errors in pixels [M, 2], errors of depth in standard deviations [M], and the points in
        their camera frames [M, 3]."""
        seen = self.seen
        viewmats = np.stack([one.viewmat for one in bundle.cameras])[seen.view]
        K = np.stack([one.K for one in bundle.cameras])[seen.view]
        local = np.einsum("mij,mj->mi", viewmats[:, :3, :3], bundle.points[seen.point])
        local += viewmats[:, :3, 3]
        with np.errstate(all="ignore"):
            place = local[:, :2] / local[:, 2:] * K[:, [0, 1], [0, 1]] + K[:, :2, 2]
            depth = (
                np.log(local[:, 2] / seen.depth) - bundle.scales[seen.view]
            ) / self.depth_deviations
        place[local[:, 2] <= 0.0] = np.inf
        return place - seen.xy, np.where(np.isfinite(seen.depth), depth, 0.0), local


def _stepped(bundle: Bundle, equations: Equations, prior: Float64, damping: float) -> Bundle | None:
    """Take a damped Gauss-Newton step; None if the equations are singular."""
    normal = without_points(equations, RIDGE + damping) + prior
    size = equations.width - 1
    information: Float64 = normal[:size, :size].copy()
    information += np.diag(damping * np.diagonal(information) + RIDGE)
    try:
        solved = np.linalg.solve(information, -normal[:size, size])
        step: Float64 = np.asarray(solved, dtype=np.float64)
        points: Float64 = bundle.points + steps_of_points(equations, step, RIDGE + damping)
    except np.linalg.LinAlgError:
        return None
    count, lenses = len(bundle.cameras), int(bundle.lenses.max()) + 1
    factors = np.exp(np.clip(step[6 * count : 6 * count + lenses], -0.5, 0.5))
    cameras = []
    for k, camera in enumerate(bundle.cameras):
        turn, move = step[6 * k : 6 * k + 3], step[6 * k + 3 : 6 * k + 6]
        viewmat = camera.viewmat.copy()
        viewmat[:3] = _rotation_of(turn) @ viewmat[:3]
        viewmat[:3, 3] += move
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= factors[bundle.lenses[k]]
        cameras.append(replace(camera, viewmat=viewmat, K=K))
    return replace(
        bundle, cameras=cameras, points=points, scales=bundle.scales + step[6 * count + lenses :]
    )


def _rotation_of(vector: Float64) -> Float64:
    """The rotation about a vector by its length (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float64 = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return rotation


def _rotation_vector(rotation: Float64) -> Float64:
    """The inverse of ``_rotation_of``."""
    axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = 0.5 * float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0)))
    return np.asarray(axis * (0.5 * angle / sine if sine > 1e-12 else 0.5))
