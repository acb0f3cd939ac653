"""Points of a scene from the depths of its photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr.capture import Points
from igsr.capture.photo_folder import Photo
from igsr.pose.alignment import AlignedPhoto

#: Points of an estimate at most; of more, evenly many of all photos are taken.
MOST_POINTS = 100_000


def fused_points(
    photos: Sequence[Photo],
    aligned: Sequence[AlignedPhoto | None],
    trusted: Sequence[npt.NDArray[np.bool_] | None],
) -> Points | None:
    """The trusted pixels of all photos as points with raw confidence, at most ``MOST_POINTS``.

    Args:
        photos: whose colours the points have.
        aligned: the same photos' depths; None where one has no place.
        trusted: [h, w] per photo.
    """
    xyz, rgb, confidence = [], [], []
    for photo, placed, sure in zip(photos, aligned, trusted, strict=True):
        if placed is None or sure is None:
            continue
        points, index = placed.world_points()
        kept = sure.ravel()[index]
        column, row = np.floor(placed.grid.photo_pixels()[index[kept]]).astype(np.int64).T
        height, width = photo.image.shape[:2]
        row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
        xyz.append(points[kept])
        rgb.append(photo.image[row, column, :3])
        confidence.append(placed.confidence.ravel()[index[kept]])
    count = sum(len(points) for points in xyz)
    if count == 0:
        return None
    taken = np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(np.int64)
    return Points(
        np.concatenate(xyz)[taken], np.concatenate(rgb)[taken], np.concatenate(confidence)[taken]
    )


def joined_points(of_features: Points | None, fused: Points | None) -> Points | None:
    """Points of features, with their tracks, and points of depths together.

    Only the order of confidences counts: what photos share is surer than any depth.

    Args:
        of_features: with tracks, or None.
        fused: with confidence, or None.
    """
    if of_features is None or fused is None or fused.confidence is None:
        return fused if of_features is None else of_features
    surest = float(fused.confidence.max())
    own = of_features.confidence
    own = np.ones(len(of_features.xyz)) if own is None else own / own.max()
    return Points(
        np.concatenate([of_features.xyz, fused.xyz]),
        np.concatenate([of_features.rgb, fused.rgb]),
        np.concatenate([surest * (1.0 + own), fused.confidence]),
        of_features.tracks,
    )
