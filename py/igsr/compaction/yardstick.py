"""What a smaller model is refined to and judged by: photos, or the model's own pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from igsr.capture import Camera, Capture, View
from igsr.errors import IgsrError
from igsr.evaluation import metrics
from igsr.evaluation.scores import default_background, over_background
from igsr.geometry.camera_paths import cameras_around
from igsr.rendering.renders import render
from igsr.splats import Splats

#: Without test views, every how many train views one judges, as in the protocol of LLFF and 3DGS.
HOLDOUT = 8
#: Cameras around a model without a capture, the side of their pictures in pixels, and every how
#: many one judges.
AROUND = 50
AROUND_SIDE = 400
AROUND_HOLDOUT = 5
#: Error assumed of a model whose error nobody knows, dB: a usual fit on views it has not seen.
DEFAULT_PSNR = 30.0
GREY = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Verdict:
    """How a smaller model does on the views that judge.

    Attributes:
        loss: dB of PSNR lost against the whole model; negative where it is better.
        psnr: dB against the photos, or against the whole model's pictures; mean over the views.
        ssim: likewise.
    """

    loss: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Yardstick:
    """Views to refine to and views to judge by; no view is in both.

    Attributes:
        refine_views: what smaller models are refined to.
        judge_views: what they are judged by.
        background: RGB in [0, 1] behind the judged pictures.
        model_psnr: dB of the whole model: against the photos, measured, or without a capture what
            is taken for its error.
        against_photos: whether the views are photos, not the whole model's own pictures.
        protocol: all this in words and numbers, for the report.
    """

    refine_views: list[View]
    judge_views: list[View]
    background: tuple[float, float, float]
    model_psnr: float
    against_photos: bool
    protocol: dict[str, Any] = field(repr=False)

    def judge(self, splats: Splats, backend: str) -> Verdict:
        """Score ``splats`` on the judging views, 8-bit pictures, masked pixels left out."""
        pairs = [
            (render(splats, view.camera, self.background, backend).to_uint8(), view)
            for view in self.judge_views
        ]
        scored = [
            (picture, over_background(view.image, self.background), view.mask)
            for picture, view in pairs
        ]
        psnrs = [metrics.psnr(*images) for images in scored]
        psnr = float(np.mean(psnrs))
        if self.against_photos:
            loss = self.model_psnr - psnr
        else:
            loss = float(np.mean([loss_of_change(psnr, self.model_psnr) for psnr in psnrs]))
        return Verdict(loss, psnr, float(np.mean([metrics.ssim(*images) for images in scored])))


def loss_of_change(psnr: float, model_psnr: float) -> float:
    """PSNR, dB, that a model of ``model_psnr`` loses by a change of its pictures of ``psnr``.

    The change is taken to be independent of the model's own error, so that their squares add up:
    10 log10(1 + MSE of the change / MSE of the model).
    """
    return 10.0 * math.log10(1.0 + 10.0 ** ((model_psnr - psnr) / 10.0))


def photo_yardstick(
    splats: Splats, capture: Capture, background: Sequence[float] | None, backend: str
) -> Yardstick:
    """Photos: refined to train views, judged by test views or else by held-out train views.

    Raises:
        IgsrError: there are no two views to share out.
    """
    if not capture.test_views and len(capture.views) >= 2:
        capture = capture.with_holdout(min(HOLDOUT, len(capture.views)))
    if not capture.test_views or not capture.train_views:
        raise IgsrError(
            f"{capture.path} needs views to refine to and others to judge by; "
            "leave --capture out to use the model's own pictures."
        )
    color = _triple(default_background(capture) if background is None else background)
    unjudged = Yardstick(capture.train_views, capture.test_views, color, 0.0, True, {})
    psnr = unjudged.judge(splats, backend).psnr
    return Yardstick(
        unjudged.refine_views,
        unjudged.judge_views,
        color,
        psnr,
        True,
        {
            "against": "photos",
            "capture": str(capture.path),
            "loss": "PSNR of the whole model less PSNR of the smaller one, against photos, "
            "means over the judging views",
            "model_psnr": psnr,
            **_protocol(unjudged),
        },
    )


def own_yardstick(
    splats: Splats, background: Sequence[float] | None, psnr: float | None, backend: str
) -> Yardstick:
    """The model's own pictures, from cameras all around it.

    Raises:
        IgsrError: there are no finite splats to look at.
    """
    color = _triple(GREY if background is None else background)
    cameras = cameras_around(splats, AROUND, AROUND_SIDE)
    refine_views = [
        View(f"around/{i}", camera, "train", _picture_with_alpha(splats, camera, backend))
        for i, camera in enumerate(cameras)
        if i % AROUND_HOLDOUT
    ]
    judge_views = [
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
    yardstick = Yardstick(refine_views, judge_views, color, model_psnr, False, {})
    return Yardstick(
        refine_views,
        judge_views,
        color,
        model_psnr,
        False,
        {
            "against": "the whole model's pictures, from cameras around it",
            "loss": "10 log10(1 + MSE against the whole model / MSE of the whole model), mean "
            "over the judging views",
            "model_psnr": model_psnr,
            "model_psnr_from": "default" if psnr is None else "given",
            **_protocol(yardstick),
        },
    )


def _protocol(yardstick: Yardstick) -> dict[str, Any]:
    return {
        "refine_views": len(yardstick.refine_views),
        "judge_views": len(yardstick.judge_views),
        "background": list(yardstick.background),
        "pixels": "8-bit sRGB",
    }


def _triple(color: Sequence[float]) -> tuple[float, float, float]:
    red, green, blue = (float(channel) for channel in color)
    return red, green, blue


def _picture_with_alpha(splats: Splats, camera: Camera, backend: str) -> Any:
    """uint8 [H, W, 4], straight alpha, so that refining sees what is open behind the model."""
    picture = render(splats, camera, (0.0, 0.0, 0.0), backend)
    coverage = np.clip(picture.alpha, 1e-6, 1.0)[..., None]
    straight = np.clip(np.nan_to_num(picture.color) / coverage, 0.0, 1.0)
    rgba = np.concatenate([straight, np.clip(picture.alpha, 0.0, 1.0)[..., None]], axis=-1)
    return np.floor(rgba * 255.0 + 0.5).astype(np.uint8)
