"""Helpers for scores that several studies share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, View
from igsr.geometry.similarity import similarity_between
from igsr_lab.denoiser.perceptual_distance import MIN_SIDE_PX, Distance, picture_distance

Picture = npt.NDArray[np.uint8]


def aligned_views(
    views: Sequence[View], true: Sequence[Camera], fitted: Sequence[Camera]
) -> list[View]:
    """Move cameras by the similarity from true to fitted train cameras."""
    to_fitted = similarity_between(true, fitted)
    return [replace(view, camera=to_fitted.camera(view.camera)) for view in views]


def masked_distance(
    distance: Distance, first: Picture, second: Picture, mask: npt.NDArray[np.bool_] | None
) -> float | None:
    """Perceptual distance of two pictures with masked pixels black; None if they are too small."""
    if min(first.shape[:2]) < MIN_SIDE_PX:
        return None
    if mask is not None:
        first, second = first * mask[..., None], second * mask[..., None]
    return picture_distance(distance, first, second)


def known_means(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, float | None]:
    """Mean of each score over the rows that have it; None if no row has it."""
    means: dict[str, float | None] = {}
    for name in names:
        known = [row[name] for row in rows if row.get(name) is not None]
        means[name] = float(np.mean(known)) if known else None
    return means
