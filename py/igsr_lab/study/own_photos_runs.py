"""Runs of ``own_photos``, each in its own process: cameras of a scene, or one scored fit."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.part_usage import Meter, Parts
from igsr.cameras import CameraSettings
from igsr.cameras.cameras_file import KeptCameras, read_cameras_file, write_cameras_file
from igsr.cameras.find import estimated_cameras, photos_at
from igsr.cameras.load import check_enough_placed
from igsr.capture import Camera, Capture, View, load_capture
from igsr.capture.downscaling import resized_camera
from igsr.capture.photo_folder import FRAMES, file_sizes
from igsr.errors import IgsrError
from igsr.evaluation.contact_sheet import save_sheet, sheet_names
from igsr.evaluation.limits import limit_of
from igsr.evaluation.quick_scores import quick_views, train_photos
from igsr.evaluation.scores import METRICS, ScoredView, default_background, score_views
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.pose_refinement import refine_cameras
from igsr.splats import Splats
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.presets import Preset, preset_keywords
from igsr_lab.study.flip_sheet import flip_sheet
from igsr_lab.study.left_half import LEFT_HALF, left_half_scores
from igsr_lab.study.scoring import aligned_views, known_means, masked_distance
from igsr_lab.study.study import Row

#: Longest side of a picture on a sheet: large enough to see fog.
SHEET_SIDE_PX = 640


@dataclass(frozen=True)
class CameraRun:
    """The cameras of one scene, which are written to ``out``.

    ``max_size`` of the photos that are loaded later is for the check of memory.
    """

    scene: str
    out: str
    max_size: int


@dataclass(frozen=True)
class OwnFit:
    """One fit of a scene, with the options of ``own_photos``."""

    scene: str
    preset: Preset
    seed: int
    backend: FitBackend
    holdout: int
    steps: int | None
    max_size: int
    score_size: int
    features: str | None
    left_half: bool
    cameras: str | None  # file of the found cameras; None if the scene has cameras
    splats: str  # file for the splats
    sheet: str | None  # file for the sheet of pictures, or None


def find_scene_cameras(data: str, run: CameraRun) -> Row:
    """Find a scene's cameras and write them; return the row.

    "failed" is the reason if too few cameras are found. The file is then empty, so that they are
    not searched again.
    """
    folder, meter = Path(data) / run.scene, Meter()
    settings = CameraSettings()
    row: Row = {"scene": run.scene, "failed": None}
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            found, _ = estimated_cameras(folder, settings, lambda event: None, run.max_size)
        given = [str(one.message) for one in caught if issubclass(one.category, UserWarning)]
        row["photos"] = len(found.names)
        row["estimator"] = settings.estimator
        row["placed"] = len(found.placed)
        row["not_placed"] = found.not_placed
        row["points"] = 0 if found.estimate.points is None else len(found.estimate.points.xyz)
        row["warnings"] = [*given, *found.estimate.warnings]
        check_enough_placed(found, settings)
        usage = meter.lap()
        write_cameras_file(Path(run.out), KeptCameras(found, file_sizes(folder), usage))
    except IgsrError as error:
        row["failed"] = str(error)
        usage = meter.lap()
        with atomic_write(Path(run.out)):
            pass
    return {**row, "parts": {"cameras": usage.plain()}}


def fit_and_score(data: str, fit: OwnFit) -> Row:
    """Load, fit and score as ``igsr fit`` does; return the row.

    All photos are scored at ``score_size``: held-out photos with their given cameras, and, for
    "psnr_refined", with cameras aligned to the fitted ones and then fitted to their photos; fitted
    photos with the cameras at the end of the fit.
    """
    parts = Parts()
    with parts.measured("decode"):
        capture = _loaded(data, fit, fit.max_size)
    background = default_background(capture)
    with parts.measured("fit"):
        keywords = preset_keywords(fit.preset, capture)
        if fit.steps is not None:
            keywords["steps"] = fit.steps
        result = fit_capture(capture, seed=fit.seed, backend=fit.backend, **keywords)
        splats, moved = result.splats, result.capture.train_views
        splats.save(fit.splats)
    row: Row = {
        "scene": fit.scene,
        "preset": fit.preset,
        "seed": fit.seed,
        "backend": fit.backend,
        "train_photos": len(capture.train_views),
        "splats": len(splats),
        "fit_size": _largest(capture.views),
    }
    was = [view.camera for view in capture.train_views]
    are = {view.name: view.camera for view in moved}
    exposures = {view.name: view.exposure for view in moved}
    del capture, result, moved  # only photos of one size are in memory
    with parts.measured("score"):
        scored = _loaded(data, fit, fit.score_size)
        test, train = scored.test_views, train_photos(scored)
        del scored
        row["score_size"] = _largest(test)
        row |= _held_out_scores(splats, test, background, fit)
        if was != list(are.values()):
            train = [_with_camera(view, are[view.name]) for view in train]
            test = aligned_views(test, was, list(are.values()))
        refined = refine_cameras(splats, test, background, backend=fit.backend)
        train = [replace(view, exposure=exposures[view.name]) for view in train]
        of_test, of_train = (
            _psnr_and_ssim(splats, views, background, fit) for views in (refined, train)
        )
        for view, (psnr, ssim) in zip(row["views"], of_test, strict=True):
            view |= {"psnr_refined": psnr, "ssim_refined": ssim}
        row["psnr_refined"], row["ssim_refined"] = np.mean(of_test, axis=0).tolist()
        row["train_psnr"], row["train_ssim"] = np.mean(of_train, axis=0).tolist()
    row["limit"] = limit_of(row["train_psnr"], row["psnr"], row["psnr_refined"]).plain()
    return {**row, "parts": parts.plain()}


def _loaded(data: str, fit: OwnFit, max_size: int) -> Capture:
    folder = Path(data) / fit.scene
    if fit.cameras is None:
        capture = load_capture(folder, max_size)
        return capture if capture.test_views else capture.with_holdout(fit.holdout)
    found = read_cameras_file(Path(fit.cameras)).found
    return found.capture(folder, photos_at(folder, FRAMES, max_size)).with_holdout(fit.holdout)


def _held_out_scores(
    splats: Splats, views: list[View], background: tuple[float, float, float], fit: OwnFit
) -> Row:
    """Mean scores, and "views" with the scores of each; write the sheet."""
    shown = sheet_names([view.name for view in views]) if fit.sheet is not None else set()
    distance = None if fit.features is None else SqueezeNetDistance(fit.features)
    pictures: list[ScoredView] = []
    rows: list[Row] = []
    for scored in score_views(splats, views, background, fit.backend):
        row: Row = {"name": scored.name, **scored.scores}
        if distance is not None:
            row["perceptual"] = masked_distance(distance, scored.render, scored.photo, scored.mask)
        if fit.left_half:
            row |= left_half_scores(scored.render, scored.photo, scored.mask)
        rows.append(row)
        if scored.name in shown:
            pictures.append(scored)
    if fit.sheet is not None:
        save_sheet(Path(fit.sheet), flip_sheet(pictures, SHEET_SIDE_PX))
    return {**known_means(rows, (*METRICS, "perceptual", *LEFT_HALF)), "views": rows}


def _psnr_and_ssim(
    splats: Splats, views: list[View], background: tuple[float, float, float], fit: OwnFit
) -> list[tuple[float, float]]:
    scored = quick_views(splats, views, background, fit.backend)
    return [(float(v.scores["psnr"] or 0.0), float(v.scores["ssim"] or 0.0)) for v in scored]


def _largest(views: list[View]) -> list[int]:
    """Width and height of the largest view."""
    camera = max((view.camera for view in views), key=lambda one: one.width * one.height)
    return [camera.width, camera.height]


def _with_camera(view: View, camera: Camera) -> View:
    """The view with a camera that was fitted at another size."""
    return replace(view, camera=resized_camera(camera, view.camera.width, view.camera.height))
