"""``evaluate``: score splats on the photos of a capture."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igsr._internal.array_equality import ArrayEquality
from igsr._internal.choices import Backend, Split
from igsr.capture import Capture, View
from igsr.errors import IgsrError
from igsr.evaluation import metrics
from igsr.evaluation.metrics import METRICS
from igsr.rendering.renders import render
from igsr.splats import Splats

logger = logging.getLogger(__name__)

BLACK = (0.0, 0.0, 0.0)
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False, repr=False)
class ScoredView(ArrayEquality):
    """One photo, its render and their scores.

    Attributes:
        name: the view's name in the capture.
        photo: uint8 [H, W, 3], over the background if it has alpha.
        render: uint8 [H, W, 3].
        mask: bool [H, W], True for pixels that count; None if all count.
        scores: "psnr" in dB, "ssim", "ms_ssim" (None if the picture is too small), "flip", and
            "cc_psnr" and "cc_ssim" after color correction.
    """

    name: str
    photo: metrics.Image
    render: metrics.Image
    mask: metrics.Mask | None
    scores: dict[str, float | None]

    def __repr__(self) -> str:
        return f"ScoredView({self.name!r}, PSNR {self.scores['psnr']:.2f} dB)"


class Scores(dict[str, Any]):
    """Mean scores over the views of a split, and the scores of each view.

    A dictionary whose items are also typed attributes: ``scores["psnr"]`` is ``scores.psnr``.

    Attributes:
        psnr: peak signal-to-noise ratio in dB, at most 100; higher is better.
        ssim: structural similarity, 1 for equal pictures; higher is better.
        ms_ssim: multi-scale SSIM over the views that are large enough; None if none is.
        flip: LDR-FLIP error, 0 for equal pictures; lower is better.
        cc_psnr: PSNR in dB after color correction, which removes exposure and white balance.
        cc_ssim: SSIM after color correction.
        protocol: the evaluation protocol: "split", "views", "background" and descriptions.
        views: of each view: "name", its scores by name, "width", "height" and "masked".
    """

    psnr: float
    ssim: float
    ms_ssim: float | None
    flip: float
    cc_psnr: float
    cc_ssim: float
    protocol: dict[str, Any]
    views: list[dict[str, Any]]

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name not in Scores.__annotations__:
                raise AttributeError(f"Scores has no attribute {name!r}")
            return self[name]

    def __repr__(self) -> str:
        ms_ssim = "-" if self.ms_ssim is None else f"{self.ms_ssim:.4f}"
        return (
            f"Scores(PSNR {self.psnr:.2f} dB, SSIM {self.ssim:.4f}, MS-SSIM {ms_ssim}, "
            f"FLIP {self.flip:.4f}, color-corrected PSNR {self.cc_psnr:.2f} dB; "
            f"{len(self.views)} {self.protocol['split']} views)"
        )


def default_background(capture: Capture) -> tuple[float, float, float]:
    """Return white if photos have alpha, as in papers on NeRF Synthetic; else black."""
    return known_background(capture.views) or BLACK


def known_background(views: Sequence[View]) -> tuple[float, float, float] | None:
    """Return white if photos have alpha; None if they show their own background."""
    return WHITE if any(view.image.shape[2] == 4 for view in views) else None


def default_split(capture: Capture) -> Split:
    """Return "test" if the capture has test views, else "train"."""
    return "test" if capture.test_views else "train"


def over_background(
    image: npt.NDArray[np.uint8], background: Sequence[float]
) -> npt.NDArray[np.uint8]:
    """Composite a photo, uint8 [H, W, 3] or [H, W, 4] with straight alpha, over RGB in [0, 1]."""
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:].astype(np.float64) / 255.0
    behind = 255.0 * np.asarray(background, dtype=np.float64)
    mixed = image[..., :3] * alpha + behind * (1.0 - alpha)
    return np.floor(np.clip(mixed, 0.0, 255.0) + 0.5).astype(np.uint8)


def views_of_split(capture: Capture, split: Split) -> list[View]:
    """Return the capture's "train" or "test" views, at least one."""
    if split not in ("train", "test"):
        raise IgsrError(f'split must be "train" or "test", not {split!r}.')
    views = capture.test_views if split == "test" else capture.train_views
    if not views:
        fix = "; hold some out (--holdout 8) or score the train views" if split == "test" else ""
        raise IgsrError(f"{capture.path} has no {split} views{fix}.")
    return views


def score_views(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    backend: Backend = "auto",
    names: Sequence[str] = METRICS,
) -> Iterator[ScoredView]:
    """Render and score views, one at a time to save memory.

    Args:
        splats: the scene.
        views: the photos with their cameras.
        background: RGB in [0, 1] behind renders and photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".
        names: metrics to compute.

    Yields:
        Each view with its scores.

    Raises:
        IgsrError: a mask leaves no pixel to score; raised before the first render.
    """
    check_masks(views)
    for view in views:
        photo = over_background(view.image, background)
        picture = render_of(splats, view, background, backend)
        scores = metrics.score(picture, photo, view.mask, names)
        yield ScoredView(view.name, photo, picture, view.mask, scores)


def render_of(
    splats: Splats, view: View, background: Sequence[float], backend: Backend = "auto"
) -> metrics.Image:
    """Render a view in 8 bits, uint8 [H, W, 3], with the view's exposure if it is known."""
    picture = render(splats, view.camera, background, backend)
    if view.exposure is not None:
        alpha = picture.alpha if view.image.shape[2] == 4 else None
        color = view.exposure.apply_to(picture.color, alpha, tuple(background))
        picture = replace(picture, color=color)
    return picture.to_uint8()


def check_masks(views: Sequence[View]) -> None:
    """Raise an ``IgsrError`` that names a view whose mask leaves no pixel to score."""
    for view in views:
        if view.mask is not None and not view.mask.any():
            raise IgsrError(f"{view.name}: its mask leaves no pixel to score; remove the view.")


def evaluate(
    splats: Splats,
    capture: Capture,
    split: Split = "test",
    background: Sequence[float] | None = None,
    backend: Backend = "auto",
    on_view: Callable[[ScoredView], None] | None = None,
) -> Scores:
    """Score ``splats`` on the views of one split.

    Scores compare 8-bit pictures (see ``igsr.evaluation.metrics``); masked pixels do not count. A
    view with a known ``exposure``, such as a fitted photo, is compared with a render of that
    exposure. Only "cc_psnr" and "cc_ssim" use the held-out photos themselves: they map the render's
    colors to the photo's first.

    Args:
        splats: the scene.
        capture: the photos and cameras.
        split: "test" or "train".
        background: RGB in [0, 1] behind renders and photos with alpha; None is white if photos
            have alpha, else black.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu" or "reference".
        on_view: called with each scored view, for progress and contact sheets.

    Returns:
        Means over the views, and the scores of each view.

    Raises:
        IgsrError: the split has no views, a mask leaves no pixel to score, or an argument cannot
            be used.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if background is None:
        background = default_background(capture)
    views = views_of_split(capture, split)
    logger.info("scoring %d %s views of %s with %r", len(views), split, capture.path, splats)
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
    means: dict[str, float | None] = {}
    for name in METRICS:
        values = [row[name] for row in rows if row[name] is not None]
        means[name] = float(np.mean(values)) if values else None
    protocol = {
        "split": split,
        "views": len(rows),
        "background": [float(channel) for channel in background],
        "pixels": "8-bit sRGB"
        + (", masked pixels left out" if any(row["masked"] for row in rows) else ""),
        "ssim": "11x11 Gaussian window, sigma 1.5, zero-padded (3DGS)",
        "flip": "LDR-FLIP, 67 pixels per degree",
        "color_correction": "quadratic map to each photo, least squares (Mip-NeRF 360)",
    }
    return Scores(**means, protocol=protocol, views=rows)
