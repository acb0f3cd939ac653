"""The normal equations of bundle adjustment, with the points eliminated.

Given the cameras, the points are independent of each other, so they can be eliminated from the
equations one by one, which leaves equations of the cameras alone (Triggs et al., "Bundle
Adjustment - A Modern Synthesis", 2000, section 6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: Points eliminated in a batch; bounds memory.
BATCH_POINTS = 512
#: Ridge added to the information, as a fraction of it, for directions that nothing observes.
RIDGE = 1e-9


@dataclass(frozen=True)
class Equations:
    """Linearized errors of M observations, R rows each.

    An observation depends on C columns of the normal equations; the last one has the errors.
    """

    point: Int64  # [M], from 0 without gaps
    column: Int64  # [M, C]
    value: Float64  # [M, R, C], derivative of the error by the parameter
    of_point: Float64  # [M, R, 3], derivative of the error by the point, per world unit
    width: int


def without_points(equations: Equations, damping: float = RIDGE) -> Float64:
    """Normal equations [width, width] of the parameters, each point at its optimum.

    Args:
        equations: of cameras and points.
        damping: of the points, as a fraction of their information.
    """
    normal = np.zeros((equations.width, equations.width))
    order = np.argsort(equations.point, kind="stable")
    point = equations.point[order]
    for first in range(0, int(point[-1]) + 1, BATCH_POINTS):
        chunk = order[slice(*np.searchsorted(point, (first, first + BATCH_POINTS)))]
        number = equations.point[chunk] - first
        column, value = equations.column[chunk], equations.value[chunk]
        of_point = equations.of_point[chunk]
        np.add.at(
            normal,
            (column[:, :, None], column[:, None, :]),
            np.einsum("mri,mrj->mij", value, value),
        )
        own = _of_points(number, of_point, damping)
        mixed = np.zeros((len(own), equations.width, 3))
        np.add.at(mixed, (number[:, None], column), np.einsum("mri,mrj->mij", value, of_point))
        half = np.linalg.solve(np.linalg.cholesky(own), mixed.swapaxes(1, 2))
        half = half.reshape(3 * len(own), -1)
        normal -= half.T @ half
    return normal


def steps_of_points(equations: Equations, step: Float64, damping: float = RIDGE) -> Float64:
    """Steps [P, 3] of the points to their optima after a step of the parameters.

    Args:
        equations: of cameras and points.
        step: [width - 1], of the parameters.
        damping: as for ``without_points``.
    """
    errors = np.einsum("mrc,mc->mr", equations.value, np.append(step, 1.0)[equations.column])
    own = _of_points(equations.point, equations.of_point, damping)
    slope = np.zeros((len(own), 3))
    np.add.at(slope, equations.point, np.einsum("mri,mr->mi", equations.of_point, errors))
    return np.asarray(-np.linalg.solve(own, slope[:, :, None])[:, :, 0])


def _of_points(point: Int64, of_point: Float64, damping: float) -> Float64:
    """Damped normal equations [P, 3, 3] of each point alone."""
    own = np.zeros((int(point.max()) + 1, 3, 3))
    np.add.at(own, point, np.einsum("mri,mrj->mij", of_point, of_point))
    own += damping * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return own


def gauge(cameras: Sequence[Camera]) -> Float64:
    """Derivatives [6 V, 7] of V cameras by rotations, translations and the scale of the world."""
    rows = []
    for camera in cameras:
        rotation, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
        own = np.zeros((6, 7))
        own[:3, :3] = -rotation
        own[3:, :3] = np.cross(rotation, shift, axisa=0, axisb=0, axisc=0)
        own[3:, 3:6] = -rotation
        own[3:, 6] = shift
        rows.append(own)
    return np.concatenate(rows)
