"""Depths at the network's resolution, where the alignment worked on fewer pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.pose.alignment import AlignedPhoto
from igsr.pose.dust3r.prediction import DensePrediction

Float64 = npt.NDArray[np.float64]


def with_dense_depth(photo: AlignedPhoto, dense: DensePrediction) -> AlignedPhoto:
    """The photo with its own pointmap's depths, corrected to what was aligned.

    The ratio of aligned depth to the pointmap's is smooth where either has an edge, for both have
    it there: it is interpolated between the samples, and edges stay as sharp as the network saw
    them.

    Args:
        photo: aligned on the samples.
        dense: its own pointmap.
    """
    own = np.where(dense.confidence > 1.0, dense.points[..., 2], 0.0).astype(np.float64)
    at_samples = own[dense.rows, dense.columns]
    known = np.isfinite(photo.depth) & (at_samples > 0.0)
    ratio = np.divide(photo.depth, at_samples, out=np.zeros_like(at_samples), where=known)
    height, width = own.shape
    down = _interpolation(dense.rows, height, photo.depth.shape[0])
    across = _interpolation(dense.columns, width, photo.depth.shape[1])
    share = down @ known @ across.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (own * (down @ ratio @ across.T) / share).astype(np.float32)
    depth[~((share > 0.0) & (own > 0.0))] = np.nan
    surest = np.maximum(dense.confidence, down @ photo.confidence @ across.T)
    confidence = np.where(own > 0.0, surest, 1.0).astype(np.float32)
    return AlignedPhoto(photo.camera, dense.grid, depth, confidence)


def _interpolation(samples: slice, size: int, count: int) -> Float64:
    """[size, count]: what each of ``size`` pixels takes of each of ``count`` samples, linearly."""
    place = (np.arange(size) - samples.start) / samples.step
    place = np.clip(place, 0.0, count - 1.0)
    return np.maximum(1.0 - np.abs(place[:, None] - np.arange(count)), 0.0)
