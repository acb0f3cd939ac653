"""``fit``: from photos, with cameras or without, to a scene with its files and scores."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.choices import FitBackend
from igsr._internal.event import Listener
from igsr._internal.settings import checked_given
from igsr.cameras import AUTO, CameraSettings, load_photos
from igsr.capture import Capture
from igsr.capture.load import Overview
from igsr.capture.photo_folder import FRAMES
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background
from igsr.fitting.announcement import announcement
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.fit_report import fit_report, score_fit, write_fit_report
from igsr.fitting.fitter import fit_device
from igsr.fitting.followed_run import FollowedRun
from igsr.fitting.presets import Quality, default_max_size
from igsr.fitting.result import FitResult
from igsr.fitting.scene_files import write_scene
from igsr.fitting.settings import (
    Density,
    ExposureMode,
    FitSettings,
    Focal,
    Initialization,
    Poses,
    TransientMode,
)
from igsr.run import Run, open_run
from igsr.splats import Splats

#: File of the checkpoint in the folder of a fit.
CHECKPOINT = "checkpoint.npz"


def fit(
    photos: str | os.PathLike[str] | Capture,
    steps: int | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
    quality: Quality = "normal",
    max_splats: int | None = None,
    sh_degree: int | None = None,
    density: Density | None = None,
    learning_rate: float | None = None,
    dropout: float | None = None,
    coarse_to_fine: bool | None = None,
    depth_weight: float | None = None,
    start: Initialization | Splats | None = None,
    poses: Poses | None = None,
    focal: Focal | None = None,
    exposure: ExposureMode | None = None,
    transients: TransientMode | None = None,
    remove_floaters: bool | None = None,
    backdrop: bool | None = None,
    background: tuple[float, float, float] | None = None,
    seed: int = 0,
    backend: FitBackend = "auto",
    holdout: int | None = None,
    max_size: int | None = None,
    estimator: str = AUTO,
    estimator_options: Mapping[str, Any] | None = None,
    frames: int = FRAMES,
    allow_missing: bool = False,
    resume: bool = False,
    progress: Listener | None = None,
) -> FitResult:
    """Fit splats to photos.

    Deterministic: the same photos, settings and seed give the same bits on one backend and
    instruction set. A resumed fit ends with the same bits as one that was never interrupted.

    Args:
        photos: a capture; or a path: a folder of photos or a video, whose cameras are found if it
            has none.
        steps: number of optimizer steps, each on one photo. None, here and below, chooses by the
            photos and ``quality``.
        out: folder for scene.ply, scene.html, cameras.json, report.html, report.json, views.png,
            the checkpoint, and cameras.npz with found cameras. None writes nothing and does not
            score.
        quality: "draft", "normal" or "high": size of photos, number of steps and splats.
        max_splats: maximum number of splats.
        sh_degree: degree of the spherical harmonics of colors, 0 to 4.
        density: density control: "mcmc" (relocation and growth up to the maximum, Kheradmand et
            al. 2024), "original" (clone, split, prune, Kerbl et al. 2023) or "fixed".
        learning_rate: learning-rate multiplier over 3DGS for the first half of training; decays to
            1. By default sqrt(30 000 / steps), from 1 to 3, and 1 if cameras are optimized.
        dropout: fraction of the splats that a step leaves out, growing from 0 to this value over
            the fit; 0 to 0.9 (DropGaussian, Park et al. 2025). Against overfitting few photos.
        coarse_to_fine: start with photos of an eighth to half of their size (DashGaussian, Chen et
            al. 2025); the last seven tenths of the steps use the full size.
        depth_weight: initial weight of the relative error to the photos' depth maps
            (``View.depth``); decays to 1 %. 0 ignores them.
        start: the initialization: "auto", "points" (of the capture), "depths" (points of depth
            maps and triangulated matches), "hull" (visual hull of photos with alpha), "rays" or
            "random". Or splats of an earlier fit: the fit then takes the last ``steps``
            of the usual schedule.
        poses: "fixed" or "joint": optimize the cameras' poses with the splats. The mean pose stays.
        focal: "fixed", "shared" (one factor for all focal lengths) or "per-camera".
        exposure: "on": optimize a gain and an offset per channel of each photo; "off"; or "auto":
            on if shared points or EXIF show different exposures.
        transients: "on": mask transient objects, such as people; "off"; or "auto": on if they are
            large and plain.
        remove_floaters: remove splats that the photos do not support after the last step.
        backdrop: add 200 splats behind the scene, on a sphere, so that what no photo shows is not
            black. Not for photos with alpha, or if a background is given.
        background: RGB in [0, 1] behind splats, and behind photos with alpha in scores. By default
            white if photos have alpha, else black. Fits to photos with alpha use random colors.
        seed: random seed.
        backend: "auto" (a real GPU if there is one, else the CPU), "cpu" or "gpu".
        holdout: hold out every Nth photo for testing, such as 8.
        max_size: longest side of photos as loaded, pixels; larger ones are reduced. By default
            1000 on the CPU and 1600 on a GPU, times 0.6 or 1.6 for quality "draft" or "high".
        estimator: finds cameras if the photos have none, as ``igsr.find_cameras``.
        estimator_options: of the estimator.
        frames: maximum number of frames taken from each video.
        allow_missing: continue if cameras of fewer than half of the photos are found.
        resume: continue from the checkpoint in ``out``.
        progress: called with each ``igsr.Event``; an exception ends the fit, after a checkpoint.
            In an interactive session, None shows a progress bar.

    Raises:
        IgsrError: an argument cannot be used, the cameras are not found, the checkpoint belongs to
            another fit, or a file cannot be written.
        UserWarning: something about the photos limits the result (``igsr.capture.photo_checks``).
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    given: dict[str, Any] = {
        "steps": steps,
        "seed": seed,
        "max_splats": max_splats,
        "sh_degree": sh_degree,
        "density": density,
        "learning_rate": learning_rate,
        "dropout": dropout,
        "coarse_to_fine": coarse_to_fine,
        "depth_weight": depth_weight,
        "poses": poses,
        "focal": focal,
        "exposure": exposure,
        "transients": transients,
        "remove_floaters": remove_floaters,
        "backdrop": backdrop,
        "background": background,
    }
    named = {} if isinstance(start, Splats) else {"start": start}
    chosen = checked_given(FitSettings, given | named)
    name = fit_device(backend)["backend"]
    max_size = default_max_size(name, quality) if max_size is None else max_size
    cameras = CameraSettings(estimator, dict(estimator_options or {}), seed, frames, allow_missing)
    loading: dict[str, Any] = {"holdout": holdout, "max_size": max_size}

    with open_run(out, progress, resume=resume) as run, ExitStack() as ending:
        followed = None
        if run.out is not None:
            followed = ending.enter_context(FollowedRun(run.out))
            run.add_listener(followed)
        announce = partial(
            _announce, run=run, chosen=chosen, quality=quality, backend=name, **loading
        )
        loaded = load_photos(photos, run, cameras, announce=announce, **loading)
        capture = loaded.capture
        color = chosen.get("background") or default_background(capture)
        if followed is not None:
            followed.show(capture, color)
        if any(view.image.shape[2] == 4 for view in capture.train_views):
            given["background"] = None  # random colors, so that none is learned
        with run.parts.measured("fit"):
            result = fit_capture(
                capture,
                quality=quality,
                start=start,
                backend=name,
                checkpoint=None if run.out is None else run.out / CHECKPOINT,
                resume=resume,
                report=run.report,
                **given,
            )
        result = replace(result, not_placed=tuple(loaded.not_placed))
        if run.out is None:
            return result
        asked = {
            "capture": str(capture.path),
            "quality": quality,
            **loading,
            **result.settings.plain(),
            "backend": name,
            "estimator": estimator,
            "estimator_options": cameras.made_by()["options"],
            "frames": frames,
            "allow_missing": allow_missing,
            "background": None if background is None else list(background),
            "igsr": _core.__version__,
        }
        return _write(run, run.out, result, color, asked, cameras_found=loaded.cameras_found)


def _announce(
    seen: Overview,
    cameras_known: bool,
    *,
    run: Run,
    chosen: dict[str, Any],
    holdout: int | None,
    max_size: int,
    quality: Quality,
    backend: str,
) -> None:
    """Print the plan of the fit, once the photos are counted."""
    if chosen.get("start") == "hull" and seen.channels < 4:
        raise IgsrError(
            f"{seen.path} has photos without alpha; start hull needs alpha in all photos."
        )
    if run.is_followed:
        for sentence in announcement(
            seen,
            holdout=holdout,
            max_size=max_size,
            quality=quality,
            given=chosen,
            backend=backend,
            cameras_known=cameras_known,
        ):
            run.note(sentence)


def _write(
    run: Run,
    out: Path,
    result: FitResult,
    color: tuple[float, float, float],
    asked: dict[str, Any],
    *,
    cameras_found: bool,
) -> FitResult:
    """Write the scene, score it and write the report."""
    write_scene(run, result.splats, result.capture, color)
    # Held-out photos of cameras that moved are scored at their best pose (see evaluate).
    refined = bool(result.capture.test_views) and (result.settings.moves_cameras or cameras_found)
    with run.parts.measured("score"):
        scored = score_fit(result, color, run, refined=refined)
    scored.scores.protocol["holdout"] = asked["holdout"]
    report = fit_report(result, scored, run, asked)
    write_fit_report(out, report, result, scored)
    return replace(result, scores=scored.scores, report=report)
