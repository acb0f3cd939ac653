"""What ``own_photos`` runs, each in a process of its own: cameras of a scene; one fit, scored."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.part_usage import Parts
from igsr.capture import Camera, Capture, View, load_capture
from igsr.capture.downscaling import resized_camera
from igsr.capture.photo_folder import FRAMES
from igsr.errors import IgsrError
from igsr.evaluation.contact_sheet import save_sheet, sheet_names
from igsr.evaluation.limits import limit_of
from igsr.evaluation.quick_scores import quick_views, train_photos
from igsr.evaluation.scores import METRICS, ScoredView, default_background, score_views
from igsr.fitting.fit_capture import fit_with_cameras
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.presets import Preset
from igsr.geometry.similarity import similarity_between
from igsr.pose import check_enough_placed, find_cameras, photos_at, read_found
from igsr.splats import Splats
from igsr_lab.denoiser.perceptual_distance import (
    SMALLEST_SIDE,
    SqueezeNetDistance,
    picture_distance,
)
from igsr_lab.study.flip_sheet import flip_sheet
from igsr_lab.study.left_half import LEFT_HALF, left_half_scores

#: Pictures on a sheet have at most so many pixels on their longest side: fog must be seen.
SHEET_SIDE = 640


@dataclass(frozen=True)
class CameraRun:
    """The cameras of one scene.

    Attributes:
        scene: folder of photos in the data.
        out: file for the cameras.
        estimator: a name of ``igsr.pose.registry``, or "auto".
        max_size: largest that photos will be loaded, for the check of memory; the cameras do not
            depend on it.
    """

    scene: str
    out: str
    estimator: str
    max_size: int


@dataclass(frozen=True)
class OwnFit:
    """One fit of a scene; everything that its scores depend on.

    Attributes:
        scene: folder of photos in the data.
        preset: a name of ``igsr.fitting.presets``.
        seed: of the fit.
        backend: what fits and renders.
        holdout: every so many photos one is held out.
        steps: of the fit; None is the preset's number.
        max_size: longest side of the photos that are fitted, pixels; None leaves it as it is.
        score_size: longest side of the photos that are scored, pixels.
        features: SqueezeNet's arrays, for "perceptual"; None leaves that out.
        left_half: whether "lh_psnr" and "lh_ssim" are scored.
        cameras: file of the found cameras; None where the scene's own are used.
        splats: file that the splats are written to.
        sheet: file for the sheet of pictures, or None.
    """

    scene: str
    preset: Preset
    seed: int
    backend: FitBackend
    holdout: int
    steps: int | None
    max_size: int | None
    score_size: int
    features: str | None
    left_half: bool
    cameras: str | None
    splats: str
    sheet: str | None


def find_scene_cameras(data: str, one: CameraRun) -> dict[str, Any]:
    """Find a scene's cameras and write them; for a process of its own.

    A scene whose cameras cannot be found, or of too few photos, has the row's "failed" say why.
    """
    parts = Parts()
    folder = Path(data) / one.scene
    row: dict[str, Any] = {"scene": one.scene, "failed": None}
    written = b""
    try:
        with parts.measured("cameras"), _warnings() as said:
            found, _ = find_cameras(folder, one.estimator, max_size=one.max_size)
        row["photos"] = len(found.names)
        row["estimator"] = found.made_by["estimator"]
        row["placed"] = len(found.placed)
        row["not_placed"] = found.not_placed
        row["points"] = 0 if found.estimate.points is None else len(found.estimate.points.xyz)
        row["warnings"] = [*said, *found.estimate.warnings]
        check_enough_placed(found, {}, allow_missing=False)
        written = found.to_bytes()
    except IgsrError as error:
        row["failed"] = str(error)
    # Where it failed the file is empty, so that it is not tried again.
    with atomic_write(Path(one.out)) as temporary:
        temporary.write_bytes(written)
    return {**row, "parts": parts.plain()}


def fit_and_score(data: str, one: OwnFit) -> dict[str, Any]:
    """Load, fit and score as ``igsr fit`` does; for a process of its own.

    Photos are scored at ``score_size``, whatever size was fitted: held-out photos with the cameras
    that they were given, and ("psnr_refined") with cameras aligned to the fitted ones, where those
    moved, and then fitted each to its photo; fitted photos with the cameras that the fit ended
    with.
    """
    parts = Parts()
    with parts.measured("decode"):
        capture = _loaded(data, one, one.max_size)
    background = default_background(capture)
    with parts.measured("fit"):
        splats, moved = fit_with_cameras(
            capture, preset=one.preset, seed=one.seed, steps=one.steps, backend=one.backend
        )
        splats.save(one.splats)
    row: dict[str, Any] = {
        "scene": one.scene,
        "preset": one.preset,
        "seed": one.seed,
        "backend": one.backend,
        "train_photos": len(capture.train_views),
        "splats": len(splats),
        "fit_size": _largest(capture.views),
    }
    was, are = ([view.camera for view in of.train_views] for of in (capture, moved))
    cameras = {view.name: view.camera for view in moved.train_views}
    exposures = {view.name: view.exposure for view in moved.train_views}
    del capture, moved
    with parts.measured("score"):
        scored = _loaded(data, one, one.score_size)
        test, train = scored.test_views, train_photos(scored)
        del scored
        row["score_size"] = _largest(test)
        row |= _held_out_scores(splats, test, background, one)
        if was != are:
            train = [_with_camera(view, cameras[view.name]) for view in train]
            to_fitted = similarity_between(was, are)
            test = [replace(view, camera=to_fitted.camera(view.camera)) for view in test]
        refined = refine_cameras(splats, test, background, backend=one.backend)
        again = _psnr_and_ssim(splats, refined, background, one)
        for view, (psnr, ssim) in zip(row["views"], again, strict=True):
            view |= {"psnr_refined": psnr, "ssim_refined": ssim}
        train = [replace(view, exposure=exposures[view.name]) for view in train]
        of_train = _psnr_and_ssim(splats, train, background, one)
        row["psnr_refined"], row["ssim_refined"] = _means(again)
        row["train_psnr"], row["train_ssim"] = _means(of_train)
    row["limit"] = limit_of(row["train_psnr"], row["psnr"], row["psnr_refined"]).plain()
    return {**row, "parts": parts.plain()}


def _loaded(data: str, one: OwnFit, max_size: int | None) -> Capture:
    folder = Path(data) / one.scene
    if one.cameras is None:
        capture = load_capture(folder, max_size)
        return capture if capture.test_views else capture.with_holdout(one.holdout)
    found = read_found(Path(one.cameras))
    return found.capture(folder, photos_at(folder, FRAMES, max_size)).with_holdout(one.holdout)


def _held_out_scores(
    splats: Splats, views: list[View], background: tuple[float, float, float], one: OwnFit
) -> dict[str, Any]:
    """Mean scores and "views", the scores of each; writes the sheet."""
    shown = sheet_names([view.name for view in views]) if one.sheet is not None else set()
    distance = None if one.features is None else SqueezeNetDistance(one.features)
    pictures: list[ScoredView] = []
    rows: list[dict[str, Any]] = []
    for scored in score_views(splats, views, background, one.backend):
        scores = dict(scored.scores)
        if distance is not None and min(scored.photo.shape[:2]) >= SMALLEST_SIDE:
            shown_pixels = True if scored.mask is None else scored.mask[..., None]
            scores["perceptual"] = picture_distance(
                distance,
                np.where(shown_pixels, scored.render, np.uint8(0)),
                np.where(shown_pixels, scored.photo, np.uint8(0)),
            )
        if one.left_half:
            scores |= left_half_scores(scored.render, scored.photo, scored.mask)
        rows.append({"name": scored.name, **scores})
        if scored.name in shown:
            pictures.append(scored)
    if one.sheet is not None:
        save_sheet(Path(one.sheet), flip_sheet(pictures, SHEET_SIDE))
    means: dict[str, Any] = {}
    for name in (*METRICS, "perceptual", *LEFT_HALF):
        known = [row[name] for row in rows if row.get(name) is not None]
        means[name] = float(np.mean(known)) if known else None
    return {**means, "views": rows}


def _psnr_and_ssim(
    splats: Splats, views: list[View], background: tuple[float, float, float], one: OwnFit
) -> list[tuple[float, float]]:
    scored = quick_views(splats, views, background, one.backend)
    return [(float(v.scores["psnr"] or 0.0), float(v.scores["ssim"] or 0.0)) for v in scored]


def _means(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    first, second = np.mean(pairs, axis=0)
    return float(first), float(second)


def _largest(views: list[View]) -> list[int]:
    """Width and height of the view with the most pixels."""
    camera = max((view.camera for view in views), key=lambda one: one.width * one.height)
    return [camera.width, camera.height]


def _with_camera(view: View, camera: Camera) -> View:
    """The view with a camera of its photo at another size."""
    return replace(view, camera=resized_camera(camera, view.camera.width, view.camera.height))


@contextlib.contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect the texts of warnings."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield texts
        texts += [str(one.message) for one in caught if issubclass(one.category, UserWarning)]
