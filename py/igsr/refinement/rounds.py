"""The steps of a round: propose novel views, denoise them, select some, refit.

The whole fit and the folds of cross-validation take the same steps. Nothing is changed in place.
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
from igsr.capture.downscaling import resized_tracks
from igsr.denoiser import Denoiser, photo_support, render_buffers
from igsr.evaluation.scores import (
    METRICS,
    default_background,
    evaluate,
    known_background,
)
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.fitter import with_train_exposures, without_exposures
from igsr.fitting.photo_statistics import photo_statistics
from igsr.fitting.presets import settings_for
from igsr.fitting.result import FitResult
from igsr.refinement.cut_highlights import with_cut_highlights
from igsr.refinement.near_sources import NearSources
from igsr.refinement.novel_views import NovelView
from igsr.refinement.progress import RefineProgress
from igsr.refinement.results import MeanScores, Stage
from igsr.refinement.selection import Candidate, Rejected, denoised_candidate, rejected
from igsr.refinement.settings import RefineSettings
from igsr.rendering.backdrop import wants_backdrop, with_backdrop
from igsr.splats import Splats

#: Novel views rendered in a round, and the maximum number that is added.
CANDIDATES = 24
MAX_SELECTED = 16
#: Time of rendering and denoising novel views, as a fraction of a fit's time.
NOVEL_VIEWS_WORK = 0.4
#: Settings of the default preset that all fits of a refinement share.
SHARED_SETTINGS = ("steps", "sh_degree", "density", "learning_rate", "dropout", "coarse_to_fine")

#: Proposes novel views from the splats, the known cameras, a maximum number and the backend.
Propose = Callable[[Splats, Sequence[Camera], int, FitBackend], Sequence[NovelView]]
#: Selects the candidates to add, at most a number of them.
Select = Callable[[Sequence[Candidate], int], list[Candidate]]


@dataclass(frozen=True, eq=False)
class Context:
    """What all rounds and folds of a refinement share.

    Attributes:
        capture: the photos; its train views have the exposures that the first fit found.
        settings: of the refinement.
        backend: "cpu" or "gpu".
        denoiser, propose, select: see ``refine``.
        fit_settings: shared settings of all fits, chosen for all photos.
        max_splats: of the whole fit.
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
    fit_settings: dict[str, Any]
    max_splats: int
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
        name: "whole", or "fold0", "fold1" ...; names the checkpoints.
        photos: the fitted photos, with exposures undone and transient objects masked.
        share: their pixels as a fraction of those of all photos; scales the number of splats.
        steps: fraction of the whole fit's steps.
        splats: after the last fit, without a backdrop, so that holes show.
        shown: ``splats`` with the backdrop, if the scene has one: scored and written.
        added: novel views that rounds have added.
    """

    name: str
    photos: list[View]
    share: float
    steps: float
    splats: Splats
    shown: Splats
    added: tuple[NovelView, ...] = ()


def make_context(
    capture: Capture,
    settings: RefineSettings,
    backend: FitBackend,
    denoiser: Denoiser,
    propose: Propose,
    select: Select,
    checkpoints: Path | None,
    resume: bool,
    progress: RefineProgress,
) -> Context:
    """Choose the settings of the fits.

    Folds have fewer photos and steps, but the settings that are chosen for all photos.
    """
    chosen = settings_for(
        photo_statistics(capture.train_views), settings.quality, steps=settings.steps
    ).plain()
    return Context(
        capture,
        settings,
        backend,
        denoiser,
        propose,
        select,
        {name: chosen[name] for name in SHARED_SETTINGS},
        int(chosen["max_splats"]),
        wants_backdrop(capture.train_views),
        checkpoints,
        resume,
        progress,
    )


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
    return context, Reconstruction("whole", photos, 1.0, 1.0, result.splats, shown)


def fit_photos(
    context: Context, name: str, photos: list[View], share: float, steps: float
) -> Reconstruction:
    """Fit some photos; see ``Reconstruction`` for the arguments."""
    splats = _fit(context, name, "fit", photos, share, steps).splats
    shown = _with_backdrop(context, splats, photos)
    return Reconstruction(name, photos, share, steps, splats, shown)


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
    context.progress.add_work(NOVEL_VIEWS_WORK * fitted.share)
    return candidates


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
    stage: Stage,
) -> Reconstruction:
    """Fit photos and novel views from the initialization of the photos.

    A fit that continued from the splats would keep their errors in places that no photo shows.
    A whole fit has another seed in each round: the same draws would err where the views err. A
    fold keeps its seed, so that chance is the same before and after its round.

    Args:
        context: of the refinement.
        fitted: the reconstruction so far.
        selected: novel views to add.
        added_before: novel views of earlier rounds, denoised again.
        stage: "refit" or "cross_validate".
    """
    number = context.progress.round
    name = f"{fitted.name}-round{number}"
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
    seed = seed_of_round(context.settings.seed, number) if stage == "refit" else None
    result = _fit(
        context, name, stage, [*fitted.photos, *views], fitted.share, fitted.steps, seed=seed
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
    """The seed of the whole fit of round ``number``, from 1."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _with_backdrop(context: Context, splats: Splats, photos: Sequence[View]) -> Splats:
    return with_backdrop(splats, photos, context.backend) if context.has_backdrop else splats


def _fit(
    context: Context,
    name: str,
    stage: Stage,
    views: list[View],
    share: float = 1.0,
    steps: float = 1.0,
    *,
    exposure: str = "off",
    transients: str = "off",
    seed: int | None = None,
) -> FitResult:
    settings = context.fit_settings
    checkpoint = None if context.checkpoints is None else context.checkpoints / f"{name}.npz"

    def report(event: Event) -> None:
        work = share * steps * event.done / event.total
        context.progress.report(stage, work, event.message)

    whole = context.capture
    sizes = {view.name: view.camera for view in whole.views}
    # Folds have halved photos.
    points = resized_tracks(whole.points, sizes, {view.name: view.camera for view in views})
    result = fit_capture(
        Capture(whole.path, views, points),
        report=report,
        backend=context.backend,
        checkpoint=checkpoint,
        resume=context.resume and checkpoint is not None and checkpoint.is_file(),
        backdrop=False,
        **{
            **settings,
            "steps": max(1, round(steps * settings["steps"])),
            "max_splats": max(1, round(share * context.max_splats)),
            "seed": context.settings.seed if seed is None else seed,
            "exposure": exposure,
            "transients": transients,
        },
    )
    context.progress.add_work(share * steps)
    return result
