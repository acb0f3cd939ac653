"""The normal equations of bundle adjustment, with the points eliminated.

Each point is seen by few cameras, and given the cameras no point has to do with another: solved for
last, the points leave equations of the cameras alone (Triggs et al., "Bundle Adjustment - A Modern
Synthesis", 2000, section 6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: Points that are eliminated at a time; bounds memory.
AT_ONCE = 512
#: Added to the information, as a part of it: along what nothing shows, all is free.
RIDGE = 1e-9


@dataclass(frozen=True)
class Equations:
    """Linearised errors of M observations, R rows each.

    The C columns are those of ``normal`` that an observation has to do with; the last one is that
    of the errors themselves.
    """

    point: Int64  # [M], from 0 without gaps
    column: Int64  # [M, C]
    value: Float64  # [M, R, C], error by unit of the parameter
    of_point: Float64  # [M, R, 3], error by world unit
    width: int


def without_points(equations: Equations, damping: float = RIDGE) -> Float64:
    """The normal equations [width, width] once each point has gone where it fits best.

    Args:
        equations: of cameras and points.
        damping: how much points are held where they are, as a part of what is known of them.
    """
    normal = np.zeros((equations.width, equations.width))
    order = np.argsort(equations.point, kind="stable")
    point = equations.point[order]
    for first in range(0, int(point[-1]) + 1, AT_ONCE):
        chunk = order[slice(*np.searchsorted(point, (first, first + AT_ONCE)))]
        number = equations.point[chunk] - first
        column, value = equations.column[chunk], equations.value[chunk]
        of_point = equations.of_point[chunk]
        np.add.at(
            normal,
            (column[:, :, None], column[:, None, :]),
            np.einsum("mri,mrj->mij", value, value),
        )
        count = int(number.max()) + 1
        own = np.zeros((count, 3, 3))
        np.add.at(own, number, np.einsum("mri,mrj->mij", of_point, of_point))
        own += damping * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        mixed = np.zeros((count, equations.width, 3))
        np.add.at(mixed, (number[:, None], column), np.einsum("mri,mrj->mij", value, of_point))
        half = np.linalg.solve(np.linalg.cholesky(own), mixed.swapaxes(1, 2))
        half = half.reshape(3 * count, -1)
        normal -= half.T @ half
    return normal


def steps_of_points(equations: Equations, step: Float64, damping: float = RIDGE) -> Float64:
    """Where each point fits best, from where it is [P, 3], once the parameters have made a step.

    Args:
        equations: of cameras and points.
        step: [width - 1], of the parameters.
        damping: as ``without_points`` had it.
    """
    of_point = equations.of_point
    errors = np.einsum("mrc,mc->mr", equations.value, np.append(step, 1.0)[equations.column])
    count = int(equations.point.max()) + 1
    own, slope = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(own, equations.point, np.einsum("mri,mrj->mij", of_point, of_point))
    np.add.at(slope, equations.point, np.einsum("mri,mr->mi", of_point, errors))
    own += damping * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(-np.linalg.solve(own, slope[:, :, None])[:, :, 0])


def gauge(cameras: Sequence[Camera]) -> Float64:
    """How turning about, moving along x, y, z and scaling the world moves V cameras [6 V, 7]."""
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
