"""Variants of the refinement loop that studies compare: ours, ours with a part left out, and the
paper's, which choose views by their true pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import FitBackend
from igsr.capture import Camera, Capture, View
from igsr.denoiser import Buffers, Denoiser, Source
from igsr.evaluation.scores import default_background, over_background
from igsr.refinement.novel_views import NovelView, novel_views
from igsr.refinement.selection import Candidate, select_views
from igsr.refinement.stages import Propose, Select
from igsr.splats import Splats
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance, picture_distance

#: Our loop, and our loop with one of its parts left out.
OURS = ("ours", "no-denoiser", "no-trust", "no-selection", "no-outward")
#: The paper's choices by the true picture: the largest fall of the perceptual distance by
#: denoising, the smallest distance after denoising, and the smallest before.
PAPER = ("improvement", "absolute", "absolute-before")
METHODS = (*OURS, *PAPER)


@dataclass(frozen=True)
class Method:
    """A loop that continues from the first fit of a run.

    Attributes:
        name: in tables and file names.
        method: of ``METHODS``.
        views: most views that a round adds.
        rounds: most rounds.
        cross_validate: whether a round of ours must help held-out photos. The paper's need
            not.
    """

    name: str
    method: str
    views: int
    rounds: int
    cross_validate: bool


@dataclass(frozen=True)
class Parts:
    """What a method gives to ``igsr.refine``."""

    denoiser: Denoiser
    propose: Propose
    select: Select
    cross_validate: bool


def parts_of(
    method: Method,
    denoiser: Denoiser,
    photos: Capture,
    given: Sequence[View],
    distance: SqueezeNetDistance | None,
) -> Parts:
    """The parts of a method's loop.

    Args:
        method: which.
        denoiser: what denoises, where the method does.
        photos: that are fitted.
        given: the views that the paper's methods may add, with their true pictures.
        distance: the perceptual distance that the paper's methods choose by.
    """

    def select(candidates: Sequence[Candidate], count: int) -> list[Candidate]:
        return select_views(candidates, method.views)

    ours = Parts(denoiser, novel_views, select, method.cross_validate)
    if method.method == "no-denoiser":
        return replace(
            ours,
            denoiser=partial(_undenoised, denoiser),
            select=partial(_most_confident, method.views),
        )
    if method.method == "no-trust":
        return replace(ours, denoiser=partial(_confident_everywhere, denoiser))
    if method.method == "no-selection":
        return replace(ours, select=partial(_first, method.views))
    if method.method == "no-outward":
        return replace(ours, propose=_between)
    if method.method in PAPER:
        assert distance is not None
        return Parts(
            partial(_confident_everywhere, denoiser),
            partial(_given_views, given),
            partial(_by_true_picture, given, photos, method, distance),
            cross_validate=False,
        )
    return ours


def _undenoised(
    denoiser: Denoiser, buffers: Buffers, photos: Sequence[Source]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The render as it is, with the confidence that the denoiser has in its own result."""
    return np.clip(np.nan_to_num(buffers.color), 0.0, 1.0), denoiser(buffers, photos)[1]


def _confident_everywhere(
    denoiser: Denoiser, buffers: Buffers, photos: Sequence[Source]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The denoised render, with full confidence."""
    picture, confidence = denoiser(buffers, photos)
    return picture, np.ones_like(confidence)


def _most_confident(views: int, candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """By confidence alone: where nothing is denoised no view has a gain."""
    return sorted(candidates, key=lambda one: -one.mean_confidence)[:views]


def _first(views: int, candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    return list(candidates[:views])


def _between(
    splats: Splats, known: Sequence[Camera], count: int, backend: FitBackend
) -> list[NovelView]:
    """Novel views between known cameras only."""
    return [view for view in novel_views(splats, known, count, backend) if view.between]


def _given_views(
    given: Sequence[View], splats: Splats, known: Sequence[Camera], count: int, backend: FitBackend
) -> list[NovelView]:
    """The given cameras that were not added yet."""
    return [
        NovelView(view.camera, 0.0, between=False)
        for view in given
        if not any(view.camera is camera for camera in known)
    ]


def _by_true_picture(
    given: Sequence[View],
    photos: Capture,
    method: Method,
    distance: SqueezeNetDistance,
    candidates: Sequence[Candidate],
    count: int,
) -> list[Candidate]:
    """The paper's Top-K, which needs the true pictures of the views that may be added."""
    background = default_background(photos)

    def rank(one: Candidate) -> float:
        truth = next(view for view in given if view.camera is one.view.camera)
        shown = True if truth.mask is None else truth.mask[..., None]
        photo = over_background(truth.image, background) * shown
        before = picture_distance(distance, one.render * shown, photo)
        if method.method == "absolute-before":
            return before
        after = picture_distance(distance, one.denoised * shown, photo)
        return after if method.method == "absolute" else after - before

    return sorted(candidates, key=rank)[: method.views]
