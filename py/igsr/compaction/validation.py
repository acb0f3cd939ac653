"""Training and validation views of a compaction: photos, or renders of the original model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import Camera, Capture, View
from igsr.errors import IgsrError
from igsr.evaluation.quick_scores import quick_views
from igsr.evaluation.scores import default_background
from igsr.geometry.camera_paths import cameras_around
from igsr.rendering.renders import render
from igsr.splats import Splats

#: Without test views, every eighth train view is held out, as in LLFF and 3DGS.
PHOTO_HOLDOUT = 8
#: Number of cameras around the model without a capture.
AROUND_CAMERAS = 50
AROUND_SIDE_PX = 400
#: Every fifth camera around the model is held out.
AROUND_HOLDOUT = 5
#: Assumed PSNR of a model, dB: typical for held-out views.
DEFAULT_PSNR_DB = 30.0
GRAY = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class ValidationScore:
    """Scores of a smaller model on the validation views.

    Attributes:
        loss: loss of PSNR against the original model, dB; negative if the smaller one is better.
        psnr: mean over the views, against photos or the original model's renders, dB.
        ssim: mean over the views.
    """

    loss: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Validation:
    """Disjoint views to fine-tune to and to validate on.

    Attributes:
        train_views: to fine-tune smaller models to.
        validation_views: to score them on.
        background: RGB in [0, 1] behind validation renders.
        model_psnr: PSNR of the original model, measured against the photos or assumed, dB.
        against_photos: whether the views are photos; else renders of the original model.
        protocol: the protocol, for the report.
    """

    train_views: list[View]
    validation_views: list[View]
    background: tuple[float, float, float]
    model_psnr: float
    against_photos: bool
    protocol: dict[str, Any] = field(repr=False)

    def score(self, splats: Splats, backend: Backend) -> ValidationScore:
        """Score ``splats`` on the validation views."""
        views = quick_views(splats, self.validation_views, self.background, backend)
        scores = [view.scores for view in views]
        psnrs = [float(score["psnr"] or 0.0) for score in scores]
        psnr = float(np.mean(psnrs))
        if self.against_photos:
            loss = self.model_psnr - psnr
        else:
            loss = float(np.mean([loss_of_change(psnr, self.model_psnr) for psnr in psnrs]))
        return ValidationScore(loss, psnr, float(np.mean([score["ssim"] for score in scores])))


def loss_of_change(psnr: float, model_psnr: float) -> float:
    """Estimate the loss of PSNR, dB, of a model if its renders change by ``psnr``.

    Assumes that the change is independent of the model's error, so that their squares add up:
    10 log10(1 + MSE of the change / MSE of the model).
    """
    return 10.0 * math.log10(1.0 + 10.0 ** ((model_psnr - psnr) / 10.0))


def photo_validation(
    splats: Splats, capture: Capture, background: Sequence[float] | None, backend: Backend
) -> Validation:
    """Validate on photos: the test views, or held-out train views if there are none."""
    if not capture.test_views and len(capture.views) >= 2:
        capture = capture.with_holdout(min(PHOTO_HOLDOUT, len(capture.views)))
    if not capture.test_views or not capture.train_views:
        raise IgsrError(
            f"{capture.path} needs at least one train view and one held-out view; "
            "leave --capture out to validate on renders of the model itself."
        )
    color = _triple(default_background(capture) if background is None else background)
    unscored = Validation(capture.train_views, capture.test_views, color, 0.0, True, {})
    psnr = unscored.score(splats, backend).psnr
    protocol = {
        "against": "photos",
        "capture": str(capture.path),
        "loss": "PSNR of the original model minus PSNR of the smaller one, against photos, "
        "means over the validation views",
        "model_psnr": psnr,
        **_protocol(unscored),
    }
    return replace(unscored, model_psnr=psnr, protocol=protocol)


def self_validation(
    splats: Splats, background: Sequence[float] | None, psnr: float | None, backend: Backend
) -> Validation:
    """Validate on renders of the original model, from cameras around it."""
    color = _triple(GRAY if background is None else background)
    train_views, validation_views = [], []
    for i, camera in enumerate(cameras_around(splats, AROUND_CAMERAS, AROUND_SIDE_PX)):
        if i % AROUND_HOLDOUT:
            picture = _picture_with_alpha(splats, camera, backend)
            train_views.append(View(f"around/{i}", camera, "train", picture))
        else:
            picture = render(splats, camera, color, backend).to_uint8()
            validation_views.append(View(f"around/{i}", camera, "test", picture))
    model_psnr = DEFAULT_PSNR_DB if psnr is None else psnr
    validation = Validation(train_views, validation_views, color, model_psnr, False, {})
    protocol = {
        "against": "renders of the original model, from cameras around it",
        "loss": "10 log10(1 + MSE against the original model / MSE of the original model), "
        "mean over the validation views",
        "model_psnr": model_psnr,
        "model_psnr_from": "default" if psnr is None else "given",
        **_protocol(validation),
    }
    return replace(validation, protocol=protocol)


def _protocol(validation: Validation) -> dict[str, Any]:
    return {
        "train_views": len(validation.train_views),
        "validation_views": len(validation.validation_views),
        "background": list(validation.background),
        "pixels": "8-bit sRGB",
    }


def _triple(color: Sequence[float]) -> tuple[float, float, float]:
    red, green, blue = (float(channel) for channel in color)
    return red, green, blue


def _picture_with_alpha(splats: Splats, camera: Camera, backend: Backend) -> Any:
    """A render, uint8 [H, W, 4], straight alpha, so that fine-tuning keeps transparency."""
    picture = render(splats, camera, (0.0, 0.0, 0.0), backend)
    coverage = np.clip(picture.alpha, 1e-6, 1.0)[..., None]
    straight = np.clip(np.nan_to_num(picture.color) / coverage, 0.0, 1.0)
    rgba = np.concatenate([straight, np.clip(picture.alpha, 0.0, 1.0)[..., None]], axis=-1)
    return np.floor(rgba * 255.0 + 0.5).astype(np.uint8)
