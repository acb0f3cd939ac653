"""The loop of the paper's Figure 1: fit; then render novel views, denoise, select, refit.

It differs from the paper's in two ways. Which novel views are added, and how much each of their
pixels counts, is decided without the true pictures. And a round is done only if cross-validation
says that it helps: if, done by folds first, it improves the scores of photos that they hold out.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

from igsr import _core
from igsr._internal.progress_bar import progress_or_bar
from igsr.capture import Capture
from igsr.capture.photo_checks import check_photos
from igsr.denoiser import Denoiser, NetworkDenoiser, load_network
from igsr.errors import IgsrError
from igsr.evaluation.scores import check_masks
from igsr.fitting.photo_support import support_of
from igsr.fitting.presets import Quality, default_max_size
from igsr.fitting.settings import ExposureMode, TransientMode
from igsr.refinement.cross_validation import FEWEST_PHOTOS, CrossValidation, Validation
from igsr.refinement.novel_views import novel_views
from igsr.refinement.results import Refined, RefineProgress, Round, Stop, StopReason
from igsr.refinement.run import RefineRun, bar_state
from igsr.refinement.selection import Rejected, select_views
from igsr.refinement.settings import AUTO, RefineSettings
from igsr.refinement.stages import NOVEL_VIEWS_WORK, Propose, Reconstruction, Select, Stages

#: Where so many photos see the same place, rounds gained nothing; "auto" does none.
ENOUGH_PHOTOS = 30.0


def refine(
    photos: str | os.PathLike[str] | Capture,
    rounds: int | str = AUTO,
    progress: Callable[[RefineProgress], bool | None] | None = None,
    *,
    steps: int | None = None,
    backend: str = "auto",
    seed: int = 0,
    denoiser: Denoiser | None = None,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    propose: Propose = novel_views,
    select: Select = select_views,
    cross_validate: bool = True,
    exposure: ExposureMode = "off",
    transients: TransientMode = "auto",
    quality: Quality = "normal",
    max_size: int | None = None,
    allow_missing: bool = False,
) -> Refined:
    """Fit photos, and improve the fit with denoised novel views.

    Args:
        photos: a capture, or a folder of photos, whose cameras are found if it has none.
        rounds: most rounds, or "auto": until one does not help, at most four, and none where so
            many photos see the same place that they leave novel views nothing to add.
        progress: called about five times a second; returning False ends the refinement with an
            ``IgsrError``, and what is done so far stays in ``out``. In an interactive session, None
            shows a progress bar.
        steps: of each fit; None is the default preset's.
        backend: "auto", "cpu" or "gpu".
        seed: of everything random; the result is deterministic for a given seed.
        denoiser: what denoises novel views; None is ``round_denoiser()``.
        out: folder for ``scene.ply``, ``cameras.json``, ``rounds/``, ``views.png``,
            ``report.json`` and ``report.html`` (``igsr.refinement.report``), written after every
            round, ``checkpoints/``, and ``capture/`` with cameras that had to be found; None
            writes nothing.
        resume: go on from the checkpoints in ``out``, to the same result. Files there stay as they
            are until there is more. Without, checkpoints of an earlier run are removed.
        propose: what proposes the cameras of novel views.
        select: which of the denoised views to add.
        cross_validate: whether a round is done with all photos only if, done by folds, it improves
            the scores of the photos that they hold out.
        exposure: "on", "off" or "auto": whether the first fit finds the photos' exposures, which
            are then taken out of them, as ``igsr.fit``.
        transients: "on", "off" or "auto": whether what one photo shows and the others do not is
            masked from the first fit on, as ``igsr.fit``.
        quality: "draft", "normal" or "high": size of photos, steps and splats.
        max_size: longest side, in pixels, of photos as loaded; larger ones are reduced. None is
            ``igsr.fitting.presets.default_max_size``. A ``Capture`` has its size.
        allow_missing: go on where the cameras of fewer than half of the photos are found; without,
            that ends with advice.

    Raises:
        IgsrError: an argument cannot be used, photos lie in ``out/capture``, or as ``igsr.fit`` and
            ``igsr.estimate_poses``.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    settings = RefineSettings(
        rounds=rounds,
        steps=steps,
        backend=backend,  # type: ignore[arg-type]  # checked there
        seed=seed,
        cross_validate=cross_validate,
        exposure=exposure,
        transients=transients,
        quality=quality,
    )
    resolved = _core.resolve_backend(settings.backend)  # a missing GPU is found here
    max_size = default_max_size(resolved, quality) if max_size is None else max_size
    with (
        progress_or_bar(progress, "refine", bar_state) as report,
        closing(RefineRun(settings, out, resume, report)) as run,
    ):
        if isinstance(photos, Capture):
            capture = photos
        else:
            capture = run.find_cameras(photos, max_size, allow_missing)
        _check_views(capture)
        stages = Stages(capture, settings, run, denoiser or round_denoiser(), propose, select)
        validation = CrossValidation(stages, capture.train_views) if cross_validate else None
        fits, novel = 1.0, NOVEL_VIEWS_WORK
        if validation is not None:
            fits, novel = fits + validation.work, novel + validation.novel_views_work
        run.prepare(capture, work=fits + settings.most_rounds * (fits + novel))

        whole = stages.fit_whole()
        if validation is not None:
            validation.use(whole.photos)
        test = stages.test_scores(whole.shown)
        refined = Refined(whole.shown, whole.shown, test, stages.capture, [], None, [], {})
        while refined.stop is None:
            refined = run.write(refined)
            run.round += 1
            refined = _round(run.round, refined, whole, stages, validation, settings)
        return run.write(refined)


def _round(
    number: int,
    refined: Refined,
    whole: Reconstruction,
    stages: Stages,
    validation: CrossValidation | None,
    settings: RefineSettings,
) -> Refined:
    """Do a round, or find out why there is none."""
    if number > settings.most_rounds:
        return replace(refined, stop=Stop(StopReason.ROUNDS_DONE, settings.most_rounds))
    seen_by = support_of(whole.photos).seen_by
    if settings.rounds == AUTO and seen_by >= ENOUGH_PHOTOS:
        # Known before the folds are fitted.
        return replace(refined, stop=Stop(StopReason.ENOUGH_PHOTOS, round(seen_by)))
    if validation and len({view.photo for view in whole.photos}) < FEWEST_PHOTOS:
        return replace(refined, stop=Stop(StopReason.TOO_FEW_PHOTOS, FEWEST_PHOTOS))

    validated = Validation()
    if validation is not None:
        # Before anything is rendered for the whole fit: a round that does not help costs no more.
        validated = validation.validate()
        if not validated.selected:
            return _ended_before(refined, validated.rejected)
        if not validated.accepted:
            done = Round(
                [], [], validated.before, validated.after, False, None, None, validated.held_out
            )
            stop = Stop(StopReason.NOT_ACCEPTED, number)
            return replace(refined, rounds=[*refined.rounds, done], stop=stop)

    views = stages.render_and_denoise(whole)
    selected, rejected = stages.select(views)
    if not selected:
        return _ended_before(refined, rejected)
    stages.refit(whole, selected, views.added_before, "refit")
    splats = whole.shown
    test = stages.test_scores(splats)
    before, after, held_out = validated.before, validated.after, validated.held_out
    done = Round(selected, rejected, before, after, True, splats, test, held_out)
    return replace(refined, splats=splats, rounds=[*refined.rounds, done])


def _ended_before(refined: Refined, rejected: list[Rejected]) -> Refined:
    """The end of a refinement of whose next round no novel view is selected."""
    if not rejected:
        return replace(refined, stop=Stop(StopReason.NO_NOVEL_VIEW))
    stop = Stop(StopReason.NONE_SELECTED, len(rejected))
    return replace(refined, stop=stop, rejected=rejected)


def round_denoiser(weights: str | os.PathLike[str] | None = None) -> NetworkDenoiser:
    """A denoiser for the rounds of ``refine``; None is the one that comes with igsr.

    It applies uncertain changes too: confidence weights say how much each counts.

    Args:
        weights: a ``.safetensors`` file; None is the denoiser that comes with igsr.

    Raises:
        IgsrError: as ``igsr.denoiser.load_network``.
    """
    return NetworkDenoiser(load_network(weights), doubt=0.0)


def _check_views(capture: Capture) -> None:
    """Find what cannot be fitted or scored before files of an earlier run are removed.

    Raises:
        IgsrError: there is nothing to fit, or photos or masks cannot be used.
    """
    if not capture.train_views:
        raise IgsrError(f"{capture.path} has no train views to fit.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the first fit gives the warnings
        check_photos(capture.train_views)
    check_masks(capture.test_views)
