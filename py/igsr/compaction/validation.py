"""The views that smaller models are fine-tuned to and validated on: photos, or own renders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
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

#: Without test views, every eighth train view is held out, as in the protocol of LLFF and 3DGS.
HOLDOUT = 8
#: Without a capture: cameras around the model, the side of their renders in pixels, and every
#: Nth of them is held out.
AROUND = 50
AROUND_SIDE = 400
AROUND_HOLDOUT = 5
#: PSNR assumed of a model without a report, dB: a usual fit on held-out views.
DEFAULT_PSNR = 30.0
GREY = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class ValidationScore:
    """Scores of a smaller model on the validation views.

    Attributes:
        loss: dB of PSNR lost against the original model; negative where it is better.
        psnr: dB against the photos, or against the original model's renders; mean over the views.
        ssim: likewise.
    """

    loss: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Validation:
    """Views to fine-tune to and views to validate on; no view is in both.

    Attributes:
        train_views: what smaller models are fine-tuned to.
        validation_views: what they are scored on.
        background: RGB in [0, 1] behind the validation renders.
        model_psnr: dB of the original model: measured against the photos, or assumed without a
            capture.
        against_photos: whether the views are photos, not renders of the original model.
        protocol: all this in words and numbers, for the report.
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
    """PSNR in dB that a model of ``model_psnr`` loses if its renders change by ``psnr``.

    The change is assumed to be independent of the model's own error, so that their squares add up:
    10 log10(1 + MSE of the change / MSE of the model).
    """
    return 10.0 * math.log10(1.0 + 10.0 ** ((model_psnr - psnr) / 10.0))


def photo_validation(
    splats: Splats, capture: Capture, background: Sequence[float] | None, backend: Backend
) -> Validation:
    """Validation on photos: the test views, or held-out train views where there are none.

    Raises:
        IgsrError: there are not at least one view to train on and one to validate on.
    """
    if not capture.test_views and len(capture.views) >= 2:
        capture = capture.with_holdout(min(HOLDOUT, len(capture.views)))
    if not capture.test_views or not capture.train_views:
        raise IgsrError(
            f"{capture.path} needs at least one train view and one held-out view; "
            "leave --capture out to validate on renders of the model itself."
        )
    color = _triple(default_background(capture) if background is None else background)
    unscored = Validation(capture.train_views, capture.test_views, color, 0.0, True, {})
    psnr = unscored.score(splats, backend).psnr
    return Validation(
        unscored.train_views,
        unscored.validation_views,
        color,
        psnr,
        True,
        {
            "against": "photos",
            "capture": str(capture.path),
            "loss": "PSNR of the original model minus PSNR of the smaller one, against photos, "
            "means over the validation views",
            "model_psnr": psnr,
            **_protocol(unscored),
        },
    )


def self_validation(
    splats: Splats, background: Sequence[float] | None, psnr: float | None, backend: Backend
) -> Validation:
    """Validation on renders of the original model, from cameras all around it.

    Raises:
        IgsrError: there are no finite splats to look at.
    """
    color = _triple(GREY if background is None else background)
    cameras = cameras_around(splats, AROUND, AROUND_SIDE)
    train_views = [
        View(f"around/{i}", camera, "train", _picture_with_alpha(splats, camera, backend))
        for i, camera in enumerate(cameras)
        if i % AROUND_HOLDOUT
    ]
    validation_views = [
        View(
            f"around/{i}",
            camera,
            "test",
            render(splats, camera, color, backend).to_uint8(),
        )
        for i, camera in enumerate(cameras)
        if i % AROUND_HOLDOUT == 0
    ]
    model_psnr = DEFAULT_PSNR if psnr is None else psnr
    validation = Validation(train_views, validation_views, color, model_psnr, False, {})
    return Validation(
        train_views,
        validation_views,
        color,
        model_psnr,
        False,
        {
            "against": "renders of the original model, from cameras around it",
            "loss": "10 log10(1 + MSE against the original model / MSE of the original model), "
            "mean over the validation views",
            "model_psnr": model_psnr,
            "model_psnr_from": "default" if psnr is None else "given",
            **_protocol(validation),
        },
    )


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
    """uint8 [H, W, 4], straight alpha, so that fine-tuning sees where the model is transparent."""
    picture = render(splats, camera, (0.0, 0.0, 0.0), backend)
    coverage = np.clip(picture.alpha, 1e-6, 1.0)[..., None]
    straight = np.clip(np.nan_to_num(picture.color) / coverage, 0.0, 1.0)
    rgba = np.concatenate([straight, np.clip(picture.alpha, 0.0, 1.0)[..., None]], axis=-1)
    return np.floor(rgba * 255.0 + 0.5).astype(np.uint8)
