"""Fewer splats that look alike from afar: those of a box in space become one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]

#: Halvings of the size of boxes that are tried to reach a number of splats.
TRIES = 30
#: Merged splats are no more opaque than this: a logit of 1 is infinite.
MOST_OPAQUE = 0.995
#: They are at most so many times larger than those that they stand for spread.
MOST_LARGER = 2.0


def merged(splats: Splats, count: int) -> Splats:
    """At most ``count`` splats in place of many, with their mean, spread, color and opacity.

    A splat counts by its opacity times its area (as in Kerbl et al., "A Hierarchical 3D Gaussian
    Representation", 2024, where the two nearest are merged, and not those of a box).

    Args:
        splats: the scene; splats that are not finite are left out.
        count: most splats to return.

    Raises:
        IgsrError: ``count`` is less than 1.
    """
    if count < 1:
        raise IgsrError(f"a level needs at least one splat, not {count}.")
    keep = splats.finite
    if not keep.all():
        splats = _rows(splats, keep)
    if len(splats) <= count:
        return splats
    means = splats.means.astype(np.float64)
    low = means.min(axis=0)
    side = float((means.max(axis=0) - low).max())
    # The smallest boxes of which no more than ``count`` are occupied.
    small, large = side / 2.0**20, max(side, 1e-12) * 1.001
    for _ in range(TRIES):
        middle = float(np.sqrt(small * large)) if small > 0.0 else 0.5 * large
        occupied = len(np.unique(np.floor((means - low) / middle).astype(np.int64), axis=0))
        small, large = (small, middle) if occupied <= count else (middle, large)
    boxes = np.floor((means - low) / large).astype(np.int64)
    _, group = np.unique(boxes, axis=0, return_inverse=True)
    return _merged_groups(splats, group.reshape(-1))


def _merged_groups(splats: Splats, group: npt.NDArray[np.int64]) -> Splats:
    count = int(group.max()) + 1
    opacity = 1.0 / (1.0 + np.exp(-splats.opacities.astype(np.float64)))
    scales = np.exp(splats.scales.astype(np.float64))
    weight = np.maximum(opacity * _area(scales), 1e-30)
    total = np.bincount(group, weight, count)

    def mean(values: Float64) -> Float64:
        flat = values.reshape(len(values), -1)
        columns = [np.bincount(group, weight * column, count) / total for column in flat.T]
        return np.stack(columns, axis=1).reshape(count, *values.shape[1:])

    places = splats.means.astype(np.float64)
    middle = mean(places)
    axes = rotations_of(splats.quats.astype(np.float64))
    spread = np.einsum("nij,nj,nkj->nik", axes, scales**2, axes)
    apart = places - middle[group]
    spread = mean(spread + apart[:, :, None] * apart[:, None, :])
    values, vectors = np.linalg.eigh(spread)
    vectors[np.linalg.det(vectors) < 0.0, :, 0] *= -1.0
    size = np.sqrt(np.maximum(values, 1e-20))
    opaque = total / _area(size)
    # What would be more than opaque is larger instead, or gaps would open between splats.
    size *= np.sqrt(np.clip(opaque / MOST_OPAQUE, 1.0, MOST_LARGER**2))[:, None]
    opaque = np.clip(opaque, 1e-4, MOST_OPAQUE)
    return Splats(
        means=middle.astype(np.float32),
        quats=_quaternions(vectors).astype(np.float32),
        scales=np.log(size).astype(np.float32),
        opacities=np.log(opaque / (1.0 - opaque)).astype(np.float32),
        sh=np.ascontiguousarray(mean(splats.sh.astype(np.float64)), np.float32),
        origin=splats.origin,
        antialiased=splats.antialiased,
    )


def _area(scales: Float64) -> Float64:
    """The surface of ellipsoids with these half axes [N, 3], up to a factor."""
    a, b, c = scales.T
    return np.asarray(a * b + b * c + c * a)


def rotations_of(quats: Float64) -> Float64:
    """Rotation matrices [N, 3, 3] of quaternions w x y z."""
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    w, x, y, z = (quats / np.where(norm > 0.0, norm, 1.0)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def _quaternions(rotations: Float64) -> Float64:
    """Quaternions w x y z [N, 4] of rotation matrices [N, 3, 3].

    The vector of the matrix K of Bar-Itzhack (2000) with the largest eigenvalue: no case is near a
    division by zero.
    """
    r = rotations
    k = np.zeros((len(r), 4, 4))
    k[:, 0, 0] = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    for i in range(3):
        j, m = (i + 1) % 3, (i + 2) % 3
        k[:, i + 1, i + 1] = r[:, i, i] - r[:, j, j] - r[:, m, m]
        k[:, 0, i + 1] = k[:, i + 1, 0] = r[:, m, j] - r[:, j, m]
        k[:, i + 1, j + 1] = k[:, j + 1, i + 1] = r[:, i, j] + r[:, j, i]
    return np.asarray(np.linalg.eigh(k)[1][:, :, 3])


def _rows(splats: Splats, keep: npt.NDArray[np.bool_]) -> Splats:
    names = ("means", "quats", "scales", "opacities", "sh")
    return replace(splats, **{name: getattr(splats, name)[keep] for name in names})
