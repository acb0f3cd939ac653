"""The similarity that brings points nearest to others, where some of the points may be wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Rounds of re-weighting; each is one closed solution.
ROUNDS = 10
#: Points whose second extent is less than this part of the first lie on one line.
FLAT = 1e-4
#: Distances below this part of the spread weigh no more: what rounding leaves is no difference.
NO_DISTANCE = 1e-7


def similarity_of_points(points: Float64, others: Float64, weights: Float64) -> Similarity | None:
    """The similarity with the least weighted sum of distances from mapped points to others.

    Least squares (Umeyama 1991), re-weighted by one over the distance (Weiszfeld) because the
    distances themselves and not their squares are what the alignment adds up: points that are far
    off then turn nothing.

    Args:
        points: [3, N].
        others: [3, N].
        weights: [N], not negative.

    Returns:
        None where the points with a weight lie on one line, or there are none.
    """
    used = weights > 0.0
    points, others, weights = points[:, used], others[:, used], weights[used]
    found: Similarity | None = None
    distance_weights = weights
    for _ in range(ROUNDS):
        solved = _least_squares(points, others, distance_weights)
        if solved is None:
            return found
        found, spread = solved
        off = np.linalg.norm(apply(found, points) - others, axis=0)
        distance_weights = weights / np.maximum(off, NO_DISTANCE * spread)
    return found


def _least_squares(
    points: Float64, others: Float64, weights: Float64
) -> tuple[Similarity, float] | None:
    """The weighted least-squares similarity, and the spread of ``others``."""
    total = weights.sum()
    if not total > 0.0:
        return None
    weights = weights / total
    mean, other_mean = points @ weights, others @ weights
    centred, other_centred = points - mean[:, None], others - other_mean[:, None]
    variance, other_variance = (
        float((x * x).sum(axis=0) @ weights) for x in (centred, other_centred)
    )
    if not (variance > 0.0 and other_variance > 0.0):
        return None
    u, values, vt = np.linalg.svd((other_centred * weights) @ centred.T)
    if values[1] <= FLAT**2 * values[0]:
        return None
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float(values @ signs) / variance
    if not scale > 0.0:
        return None
    translation = other_mean - scale * rotation @ mean
    return Similarity(scale, rotation, translation), float(np.sqrt(other_variance))


def is_spread(points: Float64, weights: Float64) -> bool:
    """Whether points [3, N] with weights [N] are not all on one line, or at one place.

    Of points without an extent no similarity can be found, and none is told by them.
    """
    total = weights.sum()
    if not total > 0.0:
        return False
    weights = weights / total
    centred = points - (points @ weights)[:, None]
    extents = np.linalg.eigvalsh((centred * weights) @ centred.T)
    return bool(extents[1] > FLAT**2 * extents[2])


def apply(similarity: Similarity, points: Float64) -> Float64:
    """The mapped points [3, N] of points [3, N]."""
    mapped: Float64 = (
        similarity.scale * similarity.rotation @ points + similarity.translation[:, None]
    )
    return mapped


#: Cameras nearer together than this, in units of their coordinates, stand at one place.
ONE_PLACE = 1e-9


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation, between two worlds.

    Attributes:
        scale: positive.
        rotation: [3, 3].
        translation: [3], units of the world that is mapped to.
    """

    scale: float
    rotation: Float64
    translation: Float64

    def camera(self, camera: Camera) -> Camera:
        """The camera that sees the mapped world as ``camera`` sees its own.

        Args:
            camera: in the world that is mapped from.
        """
        viewmat = np.eye(4)
        viewmat[:3, :3] = camera.viewmat[:3, :3] @ self.rotation.T
        centre = self.scale * self.rotation @ camera.center + self.translation
        viewmat[:3, 3] = -viewmat[:3, :3] @ centre
        return replace(camera, viewmat=viewmat)


def similarity_between(cameras: Sequence[Camera], others: Sequence[Camera]) -> Similarity:
    """The similarity that brings ``cameras`` nearest to ``others``, pair by pair.

    The rotation is the one that turns both the viewing axes and the centres' offsets from their
    mean best (Procrustes); scale and translation are those of the centres. One camera alone, or
    cameras at one place, keep their scale.

    Args:
        cameras: at least one.
        others: as many, in the same order.

    Raises:
        IgsrError: there are no cameras, or not as many of one as of the other.
    """
    if not cameras or len(cameras) != len(others):
        raise IgsrError(
            f"cameras and others must be pairs; there are {len(cameras)} and {len(others)}."
        )
    centres = np.stack([camera.center for camera in cameras])
    targets = np.stack([camera.center for camera in others])
    offsets, target_offsets = centres - centres.mean(axis=0), targets - targets.mean(axis=0)
    spread, target_spread = (float(np.linalg.norm(x)) for x in (offsets, target_offsets))
    # Rows of a world-to-camera rotation are the camera's axes in the world.
    covariance = sum(
        other.viewmat[:3, :3].T @ camera.viewmat[:3, :3]
        for camera, other in zip(cameras, others, strict=True)
    ) / len(cameras)
    # Centres come from matrix products: what rounding leaves is no direction.
    least = ONE_PLACE * (1.0 + max(float(np.abs(centres).max()), float(np.abs(targets).max())))
    if min(spread, target_spread) > least:
        covariance = covariance + target_offsets.T @ offsets / (spread * target_spread)
    u, _, vt = np.linalg.svd(covariance)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = 1.0
    if min(spread, target_spread) > least:
        matched = float(np.sum((offsets @ rotation.T) * target_offsets)) / spread**2
        scale = matched if matched > 0.0 else 1.0
    translation = targets.mean(axis=0) - scale * rotation @ centres.mean(axis=0)
    return Similarity(scale, rotation, translation)
