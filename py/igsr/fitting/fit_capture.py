"""``fit_capture``: a fit from photos with cameras to finished splats, without files or scores."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from igsr._internal.event import Listener
from igsr.capture import Capture, photos_among
from igsr.fitting.checkpoint import CheckpointFile, recorded_settings
from igsr.fitting.fingerprint import fingerprint, hash_of
from igsr.fitting.fitter import (
    first_splats,
    splat_arrays,
    with_train_cameras,
    with_train_exposures,
    without_exposures,
)
from igsr.fitting.inputs import FitInputs, prepare
from igsr.fitting.result import FitResult
from igsr.fitting.train import Trained, train
from igsr.fitting.transient_masks import any_masked, masked_fractions, masked_view, visible_splats
from igsr.floaters import remove_floaters as without_floaters
from igsr.geometry.frame import world_capture
from igsr.rendering.backdrop import wants_backdrop, with_backdrop
from igsr.splats import Splats, subset


def fit_capture(
    capture: Capture,
    *,
    start: str | Splats | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    report: Listener | None = None,
    **given: Any,
) -> FitResult:
    """Fit splats to the train views of a capture.

    Args:
        capture: photos and cameras.
        start: the initialization, or splats of an earlier fit to continue from.
        checkpoint: ``.npz`` file to save to, or None.
        resume: whether to continue from the checkpoint.
        report: called with the fit's progress; an exception ends the fit after a checkpoint.
        **given: as ``igsr.fitting.inputs.prepare``.

    Raises:
        IgsrError: an argument cannot be used, or the checkpoint belongs to another fit.
        UserWarning: see ``igsr.capture.photo_checks``; the last checkpoint cannot be written.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if isinstance(start, Splats):
        inputs = prepare(capture, initial=start, **given)
    else:
        inputs = prepare(capture, start=start, **given)
    file = None if checkpoint is None else _checkpoint_file(inputs, checkpoint)
    return finish(inputs, train(inputs, file, resume=resume, report=report), capture)


def finish(inputs: FitInputs, trained: Trained, given: Capture) -> FitResult:
    """Remove floaters, add the backdrop and return the result of a fit to ``given``."""
    settings, capture = inputs.settings, inputs.capture
    masks = iter(trained.masks)
    views = [
        masked_view(view, next(masks)) if view.split == "train" else view for view in capture.views
    ]
    capture = replace(capture, views=views)
    splats = trained.splats
    if settings.moves_cameras:
        capture = with_train_cameras(capture, trained.cameras)
    if any_masked(trained.masks):
        keep = visible_splats(
            splats, trained.cameras, trained.masks, inputs.frozen_count, inputs.backend
        )
        splats = subset(splats, keep)
    in_scene_colors = without_exposures(capture.train_views, trained.exposures)
    removed: dict[str, int] = {}
    if settings.remove_floaters:
        cleaned = without_floaters(
            splats,
            replace(capture, views=in_scene_colors),
            background=settings.background,
            seed=settings.seed,
            backend=inputs.backend,
            frozen=inputs.frozen_count,
        )
        splats, removed = cleaned.splats, cleaned.removed
    splats = first_splats(splats, len(splats) - inputs.frozen_count)
    splats = inputs.frame.inverse.splats(splats)
    capture = world_capture(inputs.frame, capture, inputs.given, given)
    wants = settings.backdrop and inputs.frozen is None
    if wants and wants_backdrop(trained.views, settings.background):
        in_scene_colors = without_exposures(capture.train_views, trained.exposures)
        splats = with_backdrop(splats, photos_among(in_scene_colors), inputs.backend)
    return FitResult(
        splats,
        with_train_exposures(capture, trained.exposures),
        settings,
        inputs.device,
        trained.started,
        trained.steps,
        trained.seconds,
        trained.loss,
        removed,
        masked_fractions([view.name for view in trained.views], trained.masks),
    )


def _checkpoint_file(inputs: FitInputs, path: Path) -> CheckpointFile:
    given = [splats for splats in (inputs.initial, inputs.frozen) if splats is not None]
    arrays = [array for splats in given for array in splat_arrays(splats).values()]
    # What "auto" came to.
    decided = replace(inputs.settings, exposure="off" if inputs.exposures is None else "on")
    if all(view.depth is None for view in inputs.views):
        decided = replace(decided, depth_weight=0.0)
    points = inputs.capture.points
    tracks = points.tracks if inputs.settings.moves_cameras and points is not None else None
    recorded = recorded_settings(
        decided,
        inputs.device,
        fingerprint(inputs.views, tracks),
        hash_of(arrays) if arrays else None,
    )
    return CheckpointFile(path, recorded)
