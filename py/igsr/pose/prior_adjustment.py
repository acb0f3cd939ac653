"""Bundle adjustment with what a network predicts as a prior: cameras and depths, each robustly.

Where features say little (places that only two photos share tell nothing of the distance to a third
photo), the prediction decides; where they say much, it is outweighed. What is predicted wrongly is
far off, and what is far off weighs little (Cauchy's loss), so one wrong camera or depth map moves
no other.
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

#: Standard deviations of what a network predicts: the logarithm of a photo's scale of depths, of a
#: depth, and of a focal length.
SCALE, DEPTH, FOCAL = 0.1, 0.05, 0.05
#: Errors of neighbouring depths hang together: those of a photo count as so many.
INDEPENDENT = 20
#: Steps at most, and the part of the cost that a step must take off to go on.
STEPS, SETTLED = 30, 1e-5
#: Damping (Levenberg-Marquardt): the first, by how much it changes, and the last.
FIRST, CHANGE, LAST = 1e-4, 10.0, 1e6
#: Pixels; no place in a photo is known better.
LEAST_ERROR = 0.05


@dataclass(frozen=True)
class Spread:
    """Standard deviations of a network's cameras.

    Attributes:
        rotation: radians.
        centre: world units.
    """

    rotation: float
    centre: float


@dataclass(frozen=True, eq=False)
class Observations:
    """Where photos see points.

    Attributes:
        view: int64 [M], index of the photo's camera.
        point: int64 [M], index of the point; every point is seen.
        xy: float64 [M, 2], pixels, without the lens's distortion.
        depth: float64 [M], z-depth there as it is predicted, world units; NaN where it is not.
    """

    view: Int64
    point: Int64
    xy: Float64
    depth: Float64


@dataclass(frozen=True, eq=False)
class Bundle:
    """Cameras and points.

    Attributes:
        cameras: V of them, with one focal length for both directions.
        lenses: int64 [V]: cameras of one number share their focal length.
        points: float64 [P, 3], world frame.
        scales: float64 [V], logarithm of what each photo's predicted depths are too large by.
    """

    cameras: Sequence[Camera]
    lenses: Int64
    points: Float64
    scales: Float64


def adjusted_bundle(
    bundle: Bundle,
    seen: Observations,
    predicted: Sequence[Camera | None],
    spread: Spread,
    pixels: float,
) -> Bundle:
    """The bundle that fits observations and prediction best, by a robust loss of each.

    Args:
        bundle: to start from.
        seen: where its cameras see its points.
        predicted: V cameras in the bundle's world; None where nothing is predicted.
        spread: of the predicted cameras.
        pixels: an observation that is off by more than that weighs less.
    """
    problem = _Problem(seen, predicted, spread, pixels, _focals(bundle))
    damping, cost = FIRST, problem.cost(bundle)
    for _ in range(STEPS):
        equations, prior = problem.linearised(bundle)
        before = cost
        while damping < LAST:
            moved = _stepped(bundle, equations, prior, damping)
            cost = before if moved is None else problem.cost(moved)
            if moved is not None and cost < before:
                bundle, damping = moved, damping / CHANGE
                break
            damping *= CHANGE
        if not cost < (1.0 - SETTLED) * before:
            break
    return bundle


def covariances(
    bundle: Bundle, seen: Observations, predicted: Sequence[Camera | None], spread: Spread
) -> Float64:
    """Covariances [V, 6, 6] of rotation (radians) about and translation along the cameras' axes.

    Turning, moving and scaling all cameras together is left out: no photo shows it.
    """
    problem = _Problem(seen, predicted, spread, 1.0, _focals(bundle))
    equations, prior = problem.linearised(bundle)
    # Observations are as exact as they turn out to be, the prediction is as given.
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


def spread_of(predicted: Sequence[Camera], right: Sequence[Camera]) -> tuple[float, float]:
    """Medians, per axis, of how far predicted cameras are from right ones: radians, world units."""
    turns = [
        np.radians(rotation_angle(a.viewmat[:3, :3] @ b.viewmat[:3, :3].T))
        for a, b in zip(predicted, right, strict=True)
    ]
    moves = [np.linalg.norm(a.center - b.center) for a, b in zip(predicted, right, strict=True)]
    return float(np.median(turns)) / np.sqrt(3.0), float(np.median(moves)) / np.sqrt(3.0)


def _focals(bundle: Bundle) -> Float64:
    """Logarithms of the focal lengths [G]."""
    focals = np.zeros(int(bundle.lenses.max()) + 1)
    for lens, camera in zip(bundle.lenses, bundle.cameras, strict=True):
        focals[lens] = np.log(camera.K[0, 0])
    return focals


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is minimised. Parameters: 6 per camera, then focal lengths, then scales of depths."""

    seen: Observations
    predicted: Sequence[Camera | None]
    spread: Spread
    pixels: float
    focals: Float64  # as predicted

    @cached_property
    def depth_deviations(self) -> Float64:
        """Standard deviations [M] of the logarithms of depths, as if they were independent."""
        known = np.isfinite(self.seen.depth)
        of_photo = np.bincount(self.seen.view, known)[self.seen.view]
        return np.asarray(DEPTH * np.sqrt(np.maximum(of_photo / INDEPENDENT, 1.0)))

    def cost(self, bundle: Bundle) -> float:
        errors, depth_errors, _ = self._errors(bundle)
        if not np.isfinite(errors).all():
            return np.inf
        cost = self.pixels**2 * np.log1p((errors**2).sum(axis=1) / self.pixels**2).sum()
        cost += np.log1p(depth_errors**2).sum()
        for one, wanted in zip(bundle.cameras, self.predicted, strict=True):
            if wanted is not None:
                cost += 6.0 * np.log1p((self._off(one, wanted) ** 2).sum() / 6.0)
        cost += (((_focals(bundle) - self.focals) / FOCAL) ** 2).sum()
        return float(cost + ((bundle.scales / SCALE) ** 2).sum())

    def deviation(self, bundle: Bundle) -> float:
        """Of observations, pixels; wrong ones do not count."""
        errors = np.linalg.norm(self._errors(bundle)[0], axis=1)
        # The median of distances in the plane is 1.18 standard deviations.
        return max(LEAST_ERROR, float(np.median(errors)) / 1.18)

    def linearised(self, bundle: Bundle) -> tuple[Equations, Float64]:
        """Equations of observations, and normal equations of what needs no point."""
        seen, count = self.seen, len(bundle.cameras)
        errors, depth_errors, local = self._errors(bundle)
        rotation = np.stack([one.viewmat[:3, :3] for one in bundle.cameras])[seen.view]
        focal = np.exp(_focals(bundle))[bundle.lenses][seen.view]
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
        for k, (one, wanted) in enumerate(zip(bundle.cameras, self.predicted, strict=True)):
            if wanted is None:
                continue
            rows = np.zeros((6, width))
            off = self._off(one, wanted)
            rows[:3, 6 * k : 6 * k + 3] = np.eye(3) / self.spread.rotation
            # The centre moves against the translation, along the camera's axes.
            rows[3:, 6 * k + 3 : 6 * k + 6] = -one.viewmat[:3, :3].T / self.spread.centre
            rows[:, -1] = off
            normal += rows.T @ rows / (1.0 + (off**2).sum() / 6.0)
        begin = 6 * count
        off = np.concatenate([(_focals(bundle) - self.focals) / FOCAL, bundle.scales / SCALE])
        unit = np.concatenate([np.full(len(self.focals), FOCAL), np.full(count, SCALE)])
        at = np.arange(begin, begin + len(off))
        normal[at, at] += 1.0 / unit**2
        normal[at, -1] += off / unit
        normal[-1, at] += off / unit
        return normal

    def _off(self, one: Camera, wanted: Camera) -> Float64:
        """How far a camera is from the predicted one [6], in standard deviations."""
        turn = _rotation_vector(one.viewmat[:3, :3] @ wanted.viewmat[:3, :3].T)
        move = one.center - wanted.center
        return np.concatenate([turn / self.spread.rotation, move / self.spread.centre])

    def _errors(self, bundle: Bundle) -> tuple[Float64, Float64, Float64]:
        """Pixels [M, 2] and standard deviations of depth [M] off, and points in their cameras."""
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
    """The bundle after a damped step of Gauss-Newton; None where there is none."""
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
    for k, one in enumerate(bundle.cameras):
        turn, move = step[6 * k : 6 * k + 3], step[6 * k + 3 : 6 * k + 6]
        viewmat = one.viewmat.copy()
        viewmat[:3] = _rotation_of(turn) @ viewmat[:3]
        viewmat[:3, 3] += move
        K = one.K.copy()
        K[[0, 1], [0, 1]] *= factors[bundle.lenses[k]]
        cameras.append(replace(one, viewmat=viewmat, K=K))
    return replace(
        bundle, cameras=cameras, points=points, scales=bundle.scales + step[6 * count + lenses :]
    )


def _rotation_of(turn: Float64) -> Float64:
    """The rotation about a vector by its length (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn / max(angle, 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float64 = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return rotation


def _rotation_vector(rotation: Float64) -> Float64:
    """The vector that a rotation turns about, of the angle's length."""
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
