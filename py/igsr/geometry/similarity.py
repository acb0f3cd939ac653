"""Similarity transforms between worlds, and their estimation from points or cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Iterations of re-weighting.
ITERATIONS = 10
#: Points are collinear if their second extent is less than this fraction of the first.
MIN_EXTENT_RATIO = 1e-4
#: Minimum distance in the weights, as a fraction of the spread: less is rounding.
MIN_DISTANCE_RATIO = 1e-7
#: Minimum spread of cameras that do not stand at one place, in units of their coordinates.
MIN_SPREAD = 1e-9


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation, from one world to another.

    ``second @ first`` applies first, then second.

    Attributes:
        scale: positive.
        rotation: [3, 3].
        translation: [3], units of the target world.
    """

    scale: float
    rotation: Float64
    translation: Float64

    def __matmul__(self, first: Similarity) -> Similarity:
        return Similarity(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.apply(first.translation[:, None])[:, 0],
        )

    def inverse(self) -> Similarity:
        """The similarity in the other direction."""
        rotation, scale = self.rotation.T, 1.0 / self.scale
        return Similarity(scale, rotation, -scale * rotation @ self.translation)

    def apply(self, points: Float64) -> Float64:
        """Map points to the target world.

        Args:
            points: [3, N].
        """
        mapped: Float64 = self.scale * self.rotation @ points + self.translation[:, None]
        return mapped

    def camera(self, camera: Camera) -> Camera:
        """Map a camera to the target world; it sees the same picture there.

        Args:
            camera: in the source world.
        """
        viewmat = np.eye(4)
        viewmat[:3, :3] = camera.viewmat[:3, :3] @ self.rotation.T
        center = self.scale * self.rotation @ camera.centre + self.translation
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        return replace(camera, viewmat=viewmat)


def similarity_of_points(points: Float64, targets: Float64, weights: Float64) -> Similarity | None:
    """Estimate the similarity with the least weighted sum of distances from points to targets.

    Least squares (Umeyama 1991), re-weighted by the inverse distance (Weiszfeld): distances, not
    their squares, are summed, so outliers have little influence.

    Args:
        points, targets: [3, N].
        weights: [N], not negative.

    Returns:
        None if the points with a weight are collinear.
    """
    used = weights > 0.0
    points, targets, weights = points[:, used], targets[:, used], weights[used]
    similarity: Similarity | None = None
    distance_weights = weights
    for _ in range(ITERATIONS):
        solved = _least_squares(points, targets, distance_weights)
        if solved is None:
            return similarity
        similarity, spread = solved
        distance = np.linalg.norm(similarity.apply(points) - targets, axis=0)
        distance_weights = weights / np.maximum(distance, MIN_DISTANCE_RATIO * spread)
    return similarity


def _least_squares(
    points: Float64, targets: Float64, weights: Float64
) -> tuple[Similarity, float] | None:
    """The weighted least-squares similarity, and the spread of the targets."""
    total = weights.sum()
    if not total > 0.0:
        return None
    weights = weights / total
    mean, target_mean = points @ weights, targets @ weights
    centered, target_centered = points - mean[:, None], targets - target_mean[:, None]
    variance, target_variance = (
        float((x * x).sum(axis=0) @ weights) for x in (centered, target_centered)
    )
    if not (variance > 0.0 and target_variance > 0.0):
        return None
    u, values, vt = np.linalg.svd((target_centered * weights) @ centered.T)
    if values[1] <= MIN_EXTENT_RATIO**2 * values[0]:
        return None
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float(values @ signs) / variance
    if not scale > 0.0:
        return None
    translation = target_mean - scale * rotation @ mean
    return Similarity(scale, rotation, translation), float(np.sqrt(target_variance))


def is_spread(points: Float64, weights: Float64) -> bool:
    """Whether points [3, N] with weights [N] determine a similarity: they are not collinear."""
    total = weights.sum()
    if not total > 0.0:
        return False
    weights = weights / total
    centered = points - (points @ weights)[:, None]
    extents = np.linalg.eigvalsh((centered * weights) @ centered.T)
    return bool(extents[1] > MIN_EXTENT_RATIO**2 * extents[2])


def similarity_between(cameras: Sequence[Camera], others: Sequence[Camera]) -> Similarity:
    """Estimate the similarity that best aligns ``cameras`` to ``others``, pair by pair.

    The rotation best aligns both the viewing axes and the offsets of the centers from their mean
    (Procrustes); scale and translation come from the centers. A single camera, and cameras at
    one place, keep their scale.

    Args:
        cameras: at least one.
        others: the corresponding cameras.

    Raises:
        IgsrError: there are no cameras, or the numbers differ.
    """
    if not cameras or len(cameras) != len(others):
        raise IgsrError(
            f"cameras and others must be pairs; there are {len(cameras)} and {len(others)}."
        )
    centers = np.stack([camera.centre for camera in cameras])
    targets = np.stack([camera.centre for camera in others])
    offsets, target_offsets = centers - centers.mean(axis=0), targets - targets.mean(axis=0)
    spread, target_spread = (float(np.linalg.norm(x)) for x in (offsets, target_offsets))
    # Rows of a world-to-camera rotation are the camera's axes in the world.
    covariance = sum(
        other.viewmat[:3, :3].T @ camera.viewmat[:3, :3]
        for camera, other in zip(cameras, others, strict=True)
    ) / len(cameras)
    # Centers come from matrix products: a smaller spread is rounding.
    least = MIN_SPREAD * (1.0 + max(float(np.abs(centers).max()), float(np.abs(targets).max())))
    apart = min(spread, target_spread) > least
    if apart:
        covariance = covariance + target_offsets.T @ offsets / (spread * target_spread)
    u, _, vt = np.linalg.svd(covariance)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = 1.0
    if apart:
        matched = float(np.sum((offsets @ rotation.T) * target_offsets)) / spread**2
        scale = matched if matched > 0.0 else 1.0
    translation = targets.mean(axis=0) - scale * rotation @ centers.mean(axis=0)
    return Similarity(scale, rotation, translation)
