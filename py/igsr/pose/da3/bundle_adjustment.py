"""Cameras of Depth Anything 3 as the start of a bundle adjustment, and depths that fit its points.

The network's cameras are a prediction: degrees and per cents may be off. Where photos share
features, bundle adjustment says better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import similarity_between
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.colmap.adjustment import AdjustedPhoto, adjusted
from igsr.pose.estimate import Progress

#: Degrees that adjusted cameras may be from the predicted ones, on average. Wrong matches turn
#: cameras much further than a network is wrong.
FARTHEST = 15.0
#: Factor by which a focal length may change.
STRETCHED = 1.5


def with_adjusted_cameras(
    photos: Sequence[Photo],
    aligned: Sequence[AlignedPhoto | None],
    seed: int,
    progress: Progress | None = None,
) -> tuple[list[AlignedPhoto | None], list[int], str]:
    """The photos with adjusted cameras, where at least two photos have features that bear them out.

    World and unit stay those of the prediction, and a photo that is not adjusted keeps its
    predicted camera. Depths of an adjusted photo get the scale at which they agree with the points
    that it sees.

    Args:
        photos: of the scene.
        aligned: what is predicted of them; None where one has no place.
        seed: random seed.
        progress: as for estimators.

    Returns:
        The photos; which of them are adjusted; and why none is, where none is: COLMAP fails, the
        photos share too few features, or the adjustment leads so far away from the prediction that
        it must be wrong.
    """
    cameras = [None if one is None else one.camera for one in aligned]
    try:
        found = adjusted(photos, cameras, seed, progress or (lambda stage, done, total: None))
    except IgsrError as error:
        return list(aligned), [], f"COLMAP failed ({error})"
    order = sorted(found)
    if len(order) < 2:
        return list(aligned), [], "the photos share too few features"
    before = [camera for i in order if (camera := cameras[i]) is not None]
    after = [found[i].camera for i in order]
    stretched = [
        max(a.K[0, 0] / b.K[0, 0], b.K[0, 0] / a.K[0, 0])
        for a, b in zip(after, before, strict=True)
    ]
    if pose_errors(after, before)["rotation"] > FARTHEST or max(stretched) > STRETCHED:
        return list(aligned), [], "it led too far from the prediction"
    back = similarity_between(after, before)
    result = list(aligned)
    for i in order:
        one = result[i]
        if one is not None:
            rescaled = _rescaled(one, found[i], back.scale)
            result[i] = replace(rescaled, camera=back.camera(found[i].camera))
    return result, order, ""


def _rescaled(photo: AlignedPhoto, seen: AdjustedPhoto, unit: float) -> AlignedPhoto:
    """The photo with its depths at the scale of the points that it sees.

    Args:
        photo: as predicted.
        seen: with points in a world of its own.
        unit: of the prediction's world, in that world's.
    """
    grid = photo.grid
    cells = (seen.pixels - [grid.offset_x, grid.offset_y]) / [grid.scale_x, grid.scale_y]
    inside = ((cells >= 0.0) & (cells < [grid.width, grid.height])).all(axis=1)
    column, row = cells[inside].astype(np.int64).T
    predicted = photo.depth[row, column].astype(np.float64)
    known = np.isfinite(predicted) & (predicted > 0.0)
    if not known.any():
        return photo
    # The median of logarithms: one wrong point, or one edge, moves nothing.
    ratio = np.exp(np.median(np.log(unit * seen.depths[inside][known] / predicted[known])))
    return replace(photo, depth=(photo.depth * ratio).astype(np.float32))
