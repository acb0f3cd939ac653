"""Score splats against the photos of a capture."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import Capture, View
from igsr.errors import IgsrError
from igsr.evaluation import metrics
from igsr.rendering.renders import render
from igsr.splats import Splats

logger = logging.getLogger(__name__)

METRICS = ("psnr", "ssim", "ms_ssim", "flip")

BLACK = (0.0, 0.0, 0.0)
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class ScoredView:
    """One photo, its render and what they scored.

    Attributes:
        name: the view's name in the capture.
        photo: uint8 [H, W, 3], composited over the background if it had alpha.
        render: uint8 [H, W, 3].
        mask: bool [H, W] of the pixels that counted, or None for all.
        scores: "psnr", "ssim", "ms_ssim" (None where the picture is too small), "flip".
    """

    name: str
    photo: metrics.Image
    render: metrics.Image
    mask: metrics.Mask | None
    scores: dict[str, float | None]


def default_background(capture: Capture) -> tuple[float, float, float]:
    """White where photos have alpha, as the NeRF-Synthetic papers score; else black."""
    return known_background(capture.views) or BLACK


def known_background(views: Sequence[View]) -> tuple[float, float, float] | None:
    """White behind photos with alpha; None where photos have none, and show what there is."""
    return WHITE if any(view.image.shape[2] == 4 for view in views) else None


def default_split(capture: Capture) -> str:
    """ "test" if the capture has test views, else "train"."""
    return "test" if capture.test_views else "train"


def over_background(
    image: npt.NDArray[np.uint8], background: Sequence[float]
) -> npt.NDArray[np.uint8]:
    """An RGB photo as it is; an RGBA photo (straight alpha) over ``background``, in 8 bits."""
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:].astype(np.float64) / 255.0
    behind = 255.0 * np.asarray(background, dtype=np.float64)
    mixed = image[..., :3] * alpha + behind * (1.0 - alpha)
    return np.floor(np.clip(mixed, 0.0, 255.0) + 0.5).astype(np.uint8)


def views_of_split(capture: Capture, split: str) -> list[View]:
    """The capture's "train" or "test" views.

    Raises:
        IgsrError: there are none, or the name is another one.
    """
    if split not in ("train", "test"):
        raise IgsrError(f'split must be "train" or "test", not {split!r}.')
    views = capture.test_views if split == "test" else capture.train_views
    if not views:
        mend = "; hold some out (--holdout 8) or score the train views" if split == "test" else ""
        raise IgsrError(f"{capture.path} has no {split} views{mend}.")
    return views


def score_views(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    backend: str = "auto",
) -> Iterator[ScoredView]:
    """Render and score views one by one (so that only what the caller keeps stays in memory).

    Raises:
        IgsrError: as ``check_masks``, before anything is rendered.
    """
    check_masks(views)
    for view in views:
        photo = over_background(view.image, background)
        picture = render(splats, view.camera, background, backend).to_uint8()
        scores = metrics.score(picture, photo, view.mask)
        yield ScoredView(view.name, photo, picture, view.mask, scores)


def check_masks(views: Sequence[View]) -> None:
    """Find views that cannot be scored.

    Raises:
        IgsrError: a mask leaves no pixel to score.
    """
    for view in views:
        if view.mask is not None and not view.mask.any():
            raise IgsrError(f"{view.name}: its mask leaves no pixel to score; leave it out.")


def evaluate(
    splats: Splats,
    capture: Capture,
    split: str = "test",
    background: Sequence[float] | None = None,
    backend: str = "auto",
    on_view: Callable[[ScoredView], None] | None = None,
) -> dict[str, Any]:
    """Score ``splats`` on the views of one split.

    The 8-bit picture is scored (see ``igsr.evaluation.metrics``), masked pixels do not count,
    photos with alpha are composited over ``background``, which is also the renders' background.

    Args:
        splats: the scene.
        capture: the photos and cameras.
        split: "test" or "train".
        background: RGB in [0, 1]; None is white where photos have alpha, else black.
        backend: "auto", "cpu", "gpu" or "reference".
        on_view: called with each view once it is scored (progress, contact sheets).

    Returns:
        "psnr", "ssim", "ms_ssim", "flip": means over the views ("ms_ssim" over those large enough
        for it, None if none is); "protocol": how it was scored; "views": one row per view.

    Raises:
        IgsrError: the split has no views, or a mask leaves nothing to score.
    """
    if background is None:
        background = default_background(capture)
    views = views_of_split(capture, split)
    rows: list[dict[str, Any]] = []
    for scored in score_views(splats, views, background, backend):
        height, width = scored.photo.shape[:2]
        rows.append(
            {
                "name": scored.name,
                **scored.scores,
                "width": width,
                "height": height,
                "masked": scored.mask is not None,
            }
        )
        if on_view is not None:
            on_view(scored)
    means = {
        name: float(np.mean(values)) if (values := _known(row[name] for row in rows)) else None
        for name in METRICS
    }
    protocol = {
        "split": split,
        "views": len(rows),
        "background": [float(channel) for channel in background],
        "pixels": "8-bit sRGB"
        + (", masked pixels left out" if any(row["masked"] for row in rows) else ""),
        "ssim": "11x11 Gaussian window, sigma 1.5, zero-padded (3DGS)",
        "flip": "LDR-FLIP, 67 pixels per degree",
    }
    return {**means, "protocol": protocol, "views": rows}


def _known(values: Iterator[float | None]) -> list[float]:
    return [value for value in values if value is not None]
