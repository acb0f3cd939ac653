"""The two scores that cost least, and those of fitted photos: how well a fit reproduces them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import Capture, View
from igsr.evaluation import metrics
from igsr.evaluation.scores import ScoredView, check_masks, over_background, render_of
from igsr.splats import Splats

#: Most fitted photos that are scored: their mean hardly changes with more, and each costs seconds.
MOST_TRAIN = 10


def train_photos(capture: Capture) -> list[View]:
    """The train views to score: all, or ``MOST_TRAIN`` evenly spaced ones, both ends among them.

    Args:
        capture: with train views.
    """
    views = capture.train_views
    if len(views) <= MOST_TRAIN:
        return views
    return [views[int(i)] for i in np.linspace(0, len(views) - 1, MOST_TRAIN).round()]


def train_scores(
    splats: Splats,
    capture: Capture,
    background: Sequence[float],
    backend: Backend = "auto",
) -> dict[str, Any]:
    """Mean PSNR and SSIM of ``train_photos``.

    Args:
        splats: the scene.
        capture: photos and cameras.
        background: RGB in [0, 1], behind renders and behind photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        "psnr" in dB, "ssim", "views" scored and "of" as many.

    Raises:
        IgsrError: a mask leaves no pixel to score.
    """
    scored = quick_views(splats, train_photos(capture), background, backend)
    return mean_of(list(scored), len(capture.train_views))


def mean_of(scored: Sequence[ScoredView], count: int) -> dict[str, Any]:
    """What ``train_scores`` returns, of views that are scored already.

    Args:
        scored: with "psnr" and "ssim".
        count: of photos that were fitted.
    """
    return {
        "psnr": float(np.mean([one.scores["psnr"] for one in scored])),
        "ssim": float(np.mean([one.scores["ssim"] for one in scored])),
        "views": len(scored),
        "of": count,
    }


def psnr_and_ssim(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    backend: Backend = "auto",
) -> list[tuple[float, float]]:
    """PSNR in dB and SSIM of each view; see ``quick_views``."""
    scored = quick_views(splats, views, background, backend)
    return [(float(one.scores["psnr"] or 0.0), float(one.scores["ssim"] or 0.0)) for one in scored]


def quick_views(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    backend: Backend = "auto",
) -> Iterator[ScoredView]:
    """Render views and score PSNR and SSIM, which cost least, and no other metric.

    Args:
        splats: the scene.
        views: photos and cameras.
        background: RGB in [0, 1], behind renders and behind photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".

    Yields:
        Each view with "psnr" in dB and "ssim".

    Raises:
        IgsrError: a mask leaves no pixel to score.
    """
    check_masks(views)
    for view in views:
        photo = over_background(view.image, background)
        picture = render_of(splats, view, background, backend)
        scores: dict[str, float | None] = {
            "psnr": metrics.psnr(picture, photo, view.mask),
            "ssim": metrics.ssim(picture, photo, view.mask),
        }
        yield ScoredView(view.name, photo, picture, view.mask, scores)
