"""``refine``: fit photos; then add denoised novel views and refit, in rounds.

The loop of the paper's Figure 1, except that the choice of novel views and the weights of their
pixels need no true pictures.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from igsr._internal.choices import FitBackend
from igsr._internal.event import Listener
from igsr.cameras import AUTO as AUTO_ESTIMATOR
from igsr.cameras import CameraSettings, load_photos
from igsr.capture import Capture
from igsr.capture.load import Overview
from igsr.capture.photo_checks import check_photos
from igsr.capture.photo_folder import FRAMES
from igsr.denoiser import Denoiser, NetworkDenoiser, load_network
from igsr.errors import IgsrError
from igsr.evaluation.scores import check_masks, default_background, known_background
from igsr.fitting.announcement import announcement
from igsr.fitting.fitter import fit_device
from igsr.fitting.followed_run import FollowedRun
from igsr.fitting.photo_statistics import photo_statistics
from igsr.fitting.presets import Quality, default_max_size
from igsr.fitting.settings import ExposureMode, TransientMode
from igsr.refinement.novel_views import novel_views
from igsr.refinement.progress import RefineProgress
from igsr.refinement.report import parts_so_far, write_refinement
from igsr.refinement.results import Refined, Round, Stop, StopReason
from igsr.refinement.rounds import (
    NOVEL_VIEWS_WORK,
    Context,
    Propose,
    Reconstruction,
    Select,
    denoise_views,
    denoiser_errors,
    fit_all,
    propose_views,
    refit,
    score_test_views,
    select_candidates,
)
from igsr.refinement.selection import PHOTO_ERROR, Rejected, select_views
from igsr.refinement.settings import AUTO, RefineSettings
from igsr.rendering.backdrop import wants_backdrop
from igsr.run import Run, open_run

#: "auto" does no round if this many photos see the same place: rounds gained nothing there.
ENOUGH_PHOTOS = 30.0
#: "auto" does no round if denoising raises the RMSE of renders of the photos by more than this
#: factor, and above ``PHOTO_ERROR``. igsr's denoiser raises it by up to 1.3, because fits reproduce
#: their photos well.
MAX_ERROR_FACTOR = 1.5


def refine(
    photos: str | os.PathLike[str] | Capture,
    rounds: int | str = AUTO,
    *,
    out: str | os.PathLike[str] | None = None,
    steps: int | None = None,
    quality: Quality = "normal",
    exposure: ExposureMode = "off",
    transients: TransientMode = "auto",
    denoiser: Denoiser | None = None,
    propose: Propose = novel_views,
    select: Select = select_views,
    seed: int = 0,
    backend: FitBackend = "auto",
    holdout: int | None = None,
    max_size: int | None = None,
    estimator: str = AUTO_ESTIMATOR,
    estimator_options: Mapping[str, Any] | None = None,
    frames: int = FRAMES,
    allow_missing: bool = False,
    resume: bool = False,
    progress: Listener | None = None,
) -> Refined:
    """Fit photos, and improve the fit with denoised novel views.

    Args:
        photos: a capture; or a path: a folder of photos or a video, whose cameras are found if it
            has none.
        rounds: number of rounds; "auto" is one, or for photos with alpha 1, 2 or 4 by quality, and
            none if 30 photos see the same place or if denoising makes renders of the photos much
            worse. Rounds end early if no novel view is found or selected.
        out: folder for scene.ply, scene.html, cameras.json, report.html, report.json, views.png,
            rounds/, checkpoints/, and cameras.npz with found cameras; written after every round.
            None writes nothing.
        steps: number of optimizer steps of each fit; None chooses by the photos.
        quality: "draft", "normal" or "high": size of photos, number of steps, splats and rounds.
        exposure: "on", "off" or "auto": whether the first fit optimizes exposures, as ``igsr.fit``;
            later fits see the photos without them.
        transients: "on", "off" or "auto": whether the first fit masks transient objects, as
            ``igsr.fit``; later fits use its masks.
        denoiser: denoises novel views; None is ``round_denoiser()``.
        propose: proposes the cameras of novel views.
        select: selects the denoised views to add.
        seed: random seed; the result is deterministic for a given seed, backend and instruction
            set.
        backend: "auto" (a real GPU if there is one, else the CPU), "cpu" or "gpu".
        holdout: as ``igsr.fit``.
        max_size: as ``igsr.fit``.
        estimator: as ``igsr.fit``.
        estimator_options: as ``igsr.fit``.
        frames: as ``igsr.fit``.
        allow_missing: as ``igsr.fit``.
        resume: continue from the checkpoints in ``out``. Without, checkpoints of an earlier run
            are removed.
        progress: called with each ``igsr.Event``; an exception ends the run, and what is done
            stays in ``out``. In an interactive session, None shows a progress bar.

    Raises:
        IgsrError: as ``igsr.fit``.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    settings = RefineSettings(
        rounds=rounds,
        steps=steps,
        backend=backend,
        seed=seed,
        exposure=exposure,
        transients=transients,
        quality=quality,
    )
    name: Any = fit_device(backend)["backend"]
    max_size = default_max_size(name, quality) if max_size is None else max_size
    cameras = CameraSettings(estimator, dict(estimator_options or {}), seed, frames, allow_missing)
    denoiser = denoiser or round_denoiser()
    with open_run(out, progress, resume=resume) as run, ExitStack() as ending:

        def announce(seen: Overview, cameras_known: bool) -> None:
            if run.is_followed:
                for sentence in announcement(
                    seen,
                    holdout=holdout,
                    max_size=max_size,
                    quality=quality,
                    given={"steps": steps},
                    backend=name,
                    cameras_known=cameras_known,
                    rounds=settings.most_rounds(seen.channels == 4),
                ):
                    run.note(sentence)

        followed = None
        if run.out is not None:
            followed = ending.enter_context(FollowedRun(run.out))
            run.add_listener(followed)
        loaded = load_photos(
            photos, run, cameras, holdout=holdout, max_size=max_size, announce=announce
        )
        capture = loaded.capture
        _check_views(capture)
        checkpoints = _prepared_folder(run)
        if followed is not None:
            followed.show(capture, default_background(capture))
        most = settings.most_rounds(known_background(capture.views) is not None)
        context = Context(
            capture=capture,
            settings=settings,
            backend=name,
            denoiser=denoiser,
            propose=propose,
            select=select,
            has_backdrop=wants_backdrop(capture.train_views),
            checkpoints=checkpoints,
            resume=resume,
            progress=RefineProgress(run, 1.0 + most * (1.0 + NOVEL_VIEWS_WORK)),
        )
        return _run_rounds(context, run, tuple(loaded.not_placed))


def round_denoiser(weights: str | os.PathLike[str] | None = None) -> NetworkDenoiser:
    """The denoiser of ``refine``'s rounds.

    It applies uncertain changes, too: confidence weights say how much each counts.

    Args:
        weights: a ``.safetensors`` file; None is the denoiser that comes with igsr.

    Raises:
        IgsrError: as ``igsr.denoiser.load_network``.
    """
    return NetworkDenoiser(load_network(weights), doubt=0.0)


def _run_rounds(context: Context, run: Run, not_placed: tuple[str, ...]) -> Refined:
    """Fit all photos, and do rounds until none is left or no novel view is selected."""
    context, whole = fit_all(context)
    test = score_test_views(context, whole.shown)
    refined = Refined(
        splats=whole.shown,
        first=whole.shown,
        first_test=test,
        capture=context.capture,
        rounds=[],
        stop=None,
        rejected=[],
        seconds={},
        not_placed=not_placed,
    )
    while True:
        refined = _write(context, run, refined)
        context.progress.round += 1
        stop = _stop_before(context, whole)
        if stop is not None:
            refined = replace(refined, stop=stop)
            break
        novel = propose_views(context, whole)
        candidates = denoise_views(context, whole, [*novel, *whole.added])
        again = candidates[len(novel) :]
        selected, rejected = select_candidates(context, candidates[: len(novel)])
        if not selected:
            refined = _without_round(refined, rejected)
            break
        whole = refit(context, whole, selected, again)
        test = score_test_views(context, whole.shown)
        done = Round(selected, rejected, whole.shown, test)
        refined = replace(refined, splats=whole.shown, rounds=[*refined.rounds, done])
    return _write(context, run, refined)


def _stop_before(context: Context, whole: Reconstruction) -> Stop | None:
    """Why there is no further round; None if there is one."""
    settings = context.settings
    most = settings.most_rounds(context.known_background is not None)
    if context.progress.round > most:
        return Stop(StopReason.ROUNDS_DONE, most)
    if settings.rounds != AUTO or context.progress.round > 1:
        return None
    overlap = photo_statistics(whole.photos).overlap
    if overlap >= ENOUGH_PHOTOS:
        return Stop(StopReason.ENOUGH_PHOTOS, round(overlap))
    before, after = denoiser_errors(context, whole)
    # A denoiser that returns NaN is harmful, too.
    if not after <= max(PHOTO_ERROR, MAX_ERROR_FACTOR * before):
        return Stop(StopReason.HARMFUL_DENOISER)
    return None


def _without_round(refined: Refined, rejected: list[Rejected]) -> Refined:
    """The result if the next round selects no novel view."""
    if not rejected:
        return replace(refined, stop=Stop(StopReason.NO_NOVEL_VIEW))
    stop = Stop(StopReason.NONE_SELECTED, len(rejected))
    return replace(refined, stop=stop, rejected=rejected)


def _write(context: Context, run: Run, refined: Refined) -> Refined:
    """Write the result so far, unless the folder already holds it; return it with its times."""
    seconds = {name: part["seconds"] for name, part in run.parts.plain().items()}
    refined = replace(refined, seconds=seconds)
    if run.out is not None and (context.progress.has_news or refined.stop is not None):
        write_refinement(run, refined, context.settings)
    return refined


def _prepared_folder(run: Run) -> Path | None:
    """Remove what an earlier run left, or read its times to resume; the checkpoints' folder."""
    if run.out is None:
        return None
    checkpoints = run.out / "checkpoints"
    if run.resume:
        for name, usage in parts_so_far(run.out).items():
            run.parts.add(name, usage)
        return checkpoints
    # A later resume must not use fits of an earlier run.
    with contextlib.suppress(OSError):
        (run.out / "report.json").unlink()
    for pattern in ("whole.npz", "whole-round[0-9]*.npz"):
        for path in checkpoints.glob(pattern):
            path.unlink(missing_ok=True)
    return checkpoints


def _check_views(capture: Capture) -> None:
    """Check the photos before files of an earlier run are removed.

    Raises:
        IgsrError: there is nothing to fit, or photos or masks cannot be used.
    """
    if not capture.train_views:
        raise IgsrError(f"{capture.path} has no train views to fit.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the first fit gives the warnings
        check_photos(capture.train_views)
    check_masks(capture.test_views)
