"""Variants of the refinement: igsr's, igsr's without one of its parts, and the paper's.

The paper's methods select views by their true pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import FitBackend
from igsr.capture import Camera, Capture, View
from igsr.denoiser import Buffers, NetworkDenoiser, Source
from igsr.evaluation.scores import default_background, over_background
from igsr.refinement.novel_views import NovelView, novel_views
from igsr.refinement.selection import Candidate, select_views
from igsr.splats import Splats
from igsr_lab.denoiser.perceptual_distance import Distance, picture_distance

#: igsr's refinement, and the same without one part.
OURS = ("ours", "no-denoiser", "no-trust", "no-selection", "no-outward")
#: The paper's selections by the true picture: largest decrease of the perceptual distance by
#: denoising, smallest distance after denoising, smallest distance before.
PAPER = ("improvement", "absolute", "absolute-before")
METHODS = (*OURS, *PAPER)


@dataclass(frozen=True)
class Method:
    """A refinement that continues from the first fit of a run."""

    name: str  # in tables and file names
    method: str  # one of ``METHODS``
    views: int  # maximum number of views added per round
    rounds: int  # maximum number of rounds


def refine_keywords(
    method: Method,
    denoiser: NetworkDenoiser,
    photos: Capture,
    given: Sequence[View],
    distance: Distance | None,
) -> dict[str, Any]:
    """Return the method's keywords of ``igsr.refine``.

    The paper's methods may add the ``given`` views, and select by the perceptual distance.
    """
    if method.method in PAPER:
        assert distance is not None
        return {
            "denoiser": partial(_full_confidence, denoiser),
            "propose": partial(_given_views, given),
            "select": partial(select_by_true_picture, given, photos, method, distance),
        }
    ours = {
        "denoiser": denoiser,
        "propose": novel_views,
        "select": lambda candidates, count: select_views(candidates, method.views),
    }
    changes: dict[str, dict[str, Any]] = {
        "ours": {},
        "no-denoiser": {
            "denoiser": partial(_undenoised, denoiser),
            # Without denoising, no view has a gain.
            "select": lambda candidates, count: sorted(
                candidates, key=lambda candidate: -candidate.mean_confidence
            )[: method.views],
        },
        "no-trust": {"denoiser": partial(_full_confidence, denoiser)},
        "no-selection": {"select": lambda candidates, count: list(candidates[: method.views])},
        "no-outward": {
            "propose": lambda *given: [view for view in novel_views(*given) if view.between]
        },
    }
    return ours | changes[method.method]


def _undenoised(
    denoiser: NetworkDenoiser, buffers: Buffers, photos: Sequence[Source]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The render itself, with the confidence of the denoised picture."""
    return np.clip(np.nan_to_num(buffers.color), 0.0, 1.0), denoiser(buffers, photos)[1]


def _full_confidence(
    denoiser: NetworkDenoiser, buffers: Buffers, photos: Sequence[Source]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    picture, confidence = denoiser(buffers, photos)
    return picture, np.ones_like(confidence)


def _given_views(
    given: Sequence[View], splats: Splats, known: Sequence[Camera], count: int, backend: FitBackend
) -> list[NovelView]:
    """The given cameras that were not added yet."""
    return [
        NovelView(view.camera, 0.0, between=False)
        for view in given
        if not any(view.camera is camera for camera in known)
    ]


def select_by_true_picture(
    given: Sequence[View],
    photos: Capture,
    method: Method,
    distance: Distance,
    candidates: Sequence[Candidate],
    count: int,
) -> list[Candidate]:
    """Select as the paper does, by the distance to the true pictures; masked pixels are black."""
    background = default_background(photos)

    def rank(candidate: Candidate) -> float:
        truth = next(view for view in given if view.camera is candidate.view.camera)
        shown = True if truth.mask is None else truth.mask[..., None]
        photo = over_background(truth.image, background) * shown
        before = picture_distance(distance, candidate.render * shown, photo)
        if method.method == "absolute-before":
            return before
        after = picture_distance(distance, candidate.denoised * shown, photo)
        return after if method.method == "absolute" else after - before

    return sorted(candidates, key=rank)[: method.views]
