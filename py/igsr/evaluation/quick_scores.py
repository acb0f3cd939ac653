"""Quick scores: PSNR and SSIM only, of all views or of a few fitted photos."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import Capture, View
from igsr.evaluation.scores import ScoredView, score_views
from igsr.splats import Splats

#: Maximum number of fitted photos to score; more hardly change their mean.
MAX_TRAIN_PHOTOS = 10

#: ``score_views`` with the metrics that are fastest to compute.
quick_views = partial(score_views, names=("psnr", "ssim"))


def train_photos(capture: Capture) -> list[View]:
    """Return at most ``MAX_TRAIN_PHOTOS`` train views, evenly spaced, including both ends."""
    views = capture.train_views
    if len(views) <= MAX_TRAIN_PHOTOS:
        return views
    return [views[int(i)] for i in np.linspace(0, len(views) - 1, MAX_TRAIN_PHOTOS).round()]


def train_scores(
    splats: Splats,
    capture: Capture,
    background: Sequence[float],
    backend: Backend = "auto",
) -> dict[str, Any]:
    """Score ``train_photos`` and return ``mean_of`` them."""
    scored = quick_views(splats, train_photos(capture), background, backend)
    return mean_of(list(scored), len(capture.train_views))


def mean_of(scored: Sequence[ScoredView], count: int) -> dict[str, Any]:
    """Average the scores of some of ``count`` photos: "psnr", "ssim", "views" and "of"."""
    return {
        "psnr": float(np.mean([one.scores["psnr"] for one in scored])),
        "ssim": float(np.mean([one.scores["ssim"] for one in scored])),
        "views": len(scored),
        "of": count,
    }
