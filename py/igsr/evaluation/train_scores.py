"""Scores of photos that were fitted: how well a fit reproduces what it was given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import Capture, View
from igsr.evaluation import metrics
from igsr.evaluation.scores import check_masks, over_background
from igsr.rendering.renders import render
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
    views = train_photos(capture)
    each = psnr_and_ssim(splats, views, background, backend)
    psnr, ssim = np.mean(each, axis=0)
    return {
        "psnr": float(psnr),
        "ssim": float(ssim),
        "views": len(views),
        "of": len(capture.train_views),
    }


def psnr_and_ssim(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    backend: Backend = "auto",
) -> list[tuple[float, float]]:
    """PSNR in dB and SSIM of each view: the two scores that cost least.

    Args:
        splats: the scene.
        views: photos and cameras.
        background: RGB in [0, 1], behind renders and behind photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".

    Raises:
        IgsrError: a mask leaves no pixel to score.
    """
    check_masks(views)
    scores = []
    for view in views:
        photo = over_background(view.image, background)
        picture = render(splats, view.camera, background, backend).to_uint8()
        psnr = metrics.psnr(picture, photo, view.mask)
        scores.append((psnr, metrics.ssim(picture, photo, view.mask)))
    return scores
