"""The steps of a round: propose novel views, denoise them, select some, refit.

Nothing is changed in place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.choices import FitBackend
from igsr._internal.event import Event
from igsr.capture import Camera, Capture, PseudoView, View
from igsr.denoiser import Denoiser, denoise, photo_support, render_buffers
from igsr.evaluation.scores import (
    METRICS,
    default_background,
    evaluate,
    known_background,
    over_background,
)
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.fitter import with_train_exposures, without_exposures
from igsr.fitting.result import FitResult
from igsr.refinement.cut_highlights import with_cut_highlights
from igsr.refinement.near_sources import NearSources
from igsr.refinement.novel_views import NovelView
from igsr.refinement.progress import RefineProgress
from igsr.refinement.results import MeanScores, Stage
from igsr.refinement.selection import Candidate, Rejected, denoised_candidate, rejected
from igsr.refinement.settings import RefineSettings
from igsr.rendering.backdrop import with_backdrop
from igsr.splats import Splats

#: Novel views rendered in a round, and the maximum number that is added.
CANDIDATES = 24
MAX_SELECTED = 16
#: Maximum number of views whose renders are denoised to check the denoiser.
CHECKED_VIEWS = 8
#: Time of rendering and denoising novel views, as a fraction of a fit's time.
NOVEL_VIEWS_WORK = 0.4

#: Proposes novel views from the splats, the known cameras, a maximum number and the backend.
Propose = Callable[[Splats, Sequence[Camera], int, FitBackend], Sequence[NovelView]]
#: Selects the candidates to add, at most a number of them.
Select = Callable[[Sequence[Candidate], int], list[Candidate]]


@dataclass(frozen=True, eq=False)
class Context:
    """What all rounds of a refinement share.

    Attributes:
        capture: the photos; its train views have the exposures that the first fit found.
        settings: of the refinement.
        backend: "cpu" or "gpu".
        denoiser, propose, select: see ``refine``.
        has_backdrop: whether scenes get a backdrop before they are scored and written.
        checkpoints: folder of the fits' checkpoints, or None.
        resume: whether fits continue from their checkpoints.
        progress: takes events.
    """

    capture: Capture
    settings: RefineSettings
    backend: FitBackend
    denoiser: Denoiser
    propose: Propose
    select: Select
    has_backdrop: bool
    checkpoints: Path | None
    resume: bool
    progress: RefineProgress

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB in [0, 1] behind renders and photos with alpha."""
        return default_background(self.capture)

    @property
    def known_background(self) -> tuple[float, float, float] | None:
        """RGB in [0, 1] behind novel views; None if photos show their own background."""
        return known_background(self.capture.views)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Splats fitted to photos and to the novel views that rounds have added.

    Attributes:
        photos: the fitted photos, with exposures undone and transient objects masked.
        splats: after the last fit, without a backdrop, so that holes show.
        shown: ``splats`` with the backdrop, if the scene has one: scored and written.
        added: novel views that rounds have added.
    """

    photos: list[View]
    splats: Splats
    shown: Splats
    added: tuple[NovelView, ...] = ()


def fit_all(context: Context) -> tuple[Context, Reconstruction]:
    """Fit all photos; find their exposures and transient objects if that is asked for.

    Returns:
        The context with the exposures, and the reconstruction. Its backdrop decides for all fits,
        so that no scene with a backdrop is compared with one without.
    """
    settings = context.settings
    result = _fit(
        context,
        "whole",
        "fit",
        context.capture.train_views,
        seed=settings.seed,
        exposure=settings.exposure,
        transients=settings.transients,
    )
    fitted = result.capture.train_views
    exposures = [view.exposure for view in fitted]
    if any(exposures):
        context = replace(context, capture=with_train_exposures(context.capture, exposures))
    photos = with_cut_highlights(
        without_exposures(fitted, exposures),
        fitted,
        result.splats,
        context.background,
        context.backend,
    )
    shown = _with_backdrop(context, result.splats, photos)
    context = replace(context, has_backdrop=shown is not result.splats)
    return context, Reconstruction(photos, result.splats, shown)


def propose_views(context: Context, fitted: Reconstruction) -> list[NovelView]:
    """Propose cameras of novel views."""
    context.progress.report("novel_views")
    known = [photo.camera for photo in fitted.photos] + [view.camera for view in fitted.added]
    return list(context.propose(fitted.splats, known, CANDIDATES, context.backend))


def denoise_views(
    context: Context, fitted: Reconstruction, views: Sequence[NovelView]
) -> list[Candidate]:
    """Render and denoise novel views."""
    splats, photos, backend = fitted.splats, fitted.photos, context.backend
    support = photo_support(splats, photos, backend)
    sources = NearSources(splats, photos, context.background, backend)
    candidates = []
    for view in views:
        buffers = render_buffers(splats, view.camera, support, context.known_background, backend)
        near = sources.of(view.camera)
        candidates.append(denoised_candidate(view, buffers, near, context.denoiser))
        context.progress.report("novel_views")
    context.progress.add_work(NOVEL_VIEWS_WORK)
    return candidates


def denoiser_errors(context: Context, fitted: Reconstruction) -> tuple[float, float]:
    """RMSE of renders of the photos, before and after they are denoised; colors are in [0, 1].

    The denoiser does not get the photo itself. Masked pixels do not count.
    """
    splats, photos, backend = fitted.splats, fitted.photos, context.backend
    support = photo_support(splats, photos, backend)
    sources = NearSources(splats, photos, context.background, backend)
    sums, count = np.zeros(2), 0
    for k in np.linspace(0, len(photos) - 1, min(len(photos), CHECKED_VIEWS)).round().astype(int):
        camera, mask = photos[k].camera, photos[k].mask
        buffers = render_buffers(splats, camera, support, context.known_background, backend)
        others = [source for source in sources.of(camera) if source.camera is not camera]
        denoised, _ = denoise(buffers, others, context.denoiser)
        true = over_background(photos[k].image, context.background) / np.float32(255.0)
        shown = np.ones(true.shape[:2], np.bool_) if mask is None else mask
        render = np.clip(np.nan_to_num(buffers.color), 0.0, 1.0)
        for at, picture in enumerate((render, denoised)):
            sums[at] += np.square(picture - true)[shown].sum(dtype=np.float64)
        count += 3 * int(shown.sum())
        context.progress.report("novel_views")
    before, after = np.sqrt(sums / count)
    return float(before), float(after)


def select_candidates(
    context: Context, candidates: Sequence[Candidate]
) -> tuple[list[Candidate], list[Rejected]]:
    """Select the candidates to add; return them and the others."""
    selected = context.select(candidates, MAX_SELECTED)
    chosen = {id(candidate) for candidate in selected}
    return selected, [rejected(c) for c in candidates if id(c) not in chosen]


def refit(
    context: Context,
    fitted: Reconstruction,
    selected: Sequence[Candidate],
    added_before: Sequence[Candidate],
) -> Reconstruction:
    """Fit photos and novel views from the initialization of the photos.

    A fit that continued from the splats would keep their errors in places that no photo shows.
    Each round has another seed: the same draws would err where the views err.

    Args:
        context: of the refinement.
        fitted: the reconstruction so far.
        selected: novel views to add.
        added_before: novel views of earlier rounds, denoised again.
    """
    number = context.progress.round
    name = f"whole-round{number}"
    views: list[View] = [
        PseudoView(
            f"{name}-{index}.png",
            candidate.view.camera,
            "train",
            candidate.denoised,
            weights=candidate.confidence,
            background=context.known_background,
        )
        for index, candidate in enumerate((*selected, *added_before))
    ]
    result = _fit(
        context,
        name,
        "refit",
        [*fitted.photos, *views],
        seed=seed_of_round(context.settings.seed, number),
        exposure="off",
        transients="off",
    )
    return replace(
        fitted,
        splats=result.splats,
        shown=_with_backdrop(context, result.splats, fitted.photos),
        added=(*fitted.added, *(candidate.view for candidate in selected)),
    )


def score_test_views(context: Context, splats: Splats) -> MeanScores | None:
    """Mean scores of the test views; None if there are none."""
    if not context.capture.test_views:
        return None
    scores = evaluate(splats, context.capture, "test", context.background, context.backend)
    context.progress.report("test")
    return {metric: scores[metric] for metric in METRICS}


def seed_of_round(seed: int, number: int) -> int:
    """The seed of the fit of round ``number``, from 1."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _with_backdrop(context: Context, splats: Splats, photos: Sequence[View]) -> Splats:
    return with_backdrop(splats, photos, context.backend) if context.has_backdrop else splats


def _fit(context: Context, name: str, stage: Stage, views: list[View], **given: Any) -> FitResult:
    """Fit views; ``name`` is that of the checkpoint, ``given`` are settings of ``fit_capture``."""
    checkpoint = None if context.checkpoints is None else context.checkpoints / f"{name}.npz"

    def report(event: Event) -> None:
        context.progress.report(stage, event.done / event.total, event.message)

    result = fit_capture(
        Capture(context.capture.path, views, context.capture.points),
        report=report,
        backend=context.backend,
        checkpoint=checkpoint,
        resume=context.resume and checkpoint is not None and checkpoint.is_file(),
        backdrop=False,
        quality=context.settings.quality,
        steps=context.settings.steps,
        **given,
    )
    context.progress.add_work(1.0)
    return result
