"""The fits that studies are made of: scenes, their views, presets and seeds, fitted and scored."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.capture import Capture
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background, evaluate
from igsr.fitting.fit_capture import fit_with_cameras
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.presets import Preset, preset_settings
from igsr.geometry.similarity import similarity_between
from igsr.splats import Splats

SCORES = ("psnr", "ssim", "flip", "cc_psnr", "cc_ssim")


@dataclass(frozen=True)
class Fit:
    """One fit of a study; everything that its scores depend on.

    Attributes:
        scene: name of the scene's folder.
        views: which photos are fitted, as the protocol calls them.
        preset: a name of ``igsr.fitting.presets``.
        seed: of the fit.
        backend: what fits and renders.
    """

    scene: str
    views: str
    preset: Preset
    seed: int
    backend: FitBackend


#: The capture of a fit, with the protocol's train and test views, from the folder of the scenes. A
#: function of a module, since processes are started with it.
Load = Callable[[str, Fit], Capture]


def run_fit(load: Load, data: str, one: Fit, refined: bool = False) -> dict[str, Any]:
    """Fit and score; for a process of its own.

    As ``igsr fit`` does it: photos with alpha are fitted over random colours and scored over white,
    photos without are fitted and scored over black, and masked pixels count in neither.

    With ``refined`` the row has "psnr_refined" too: test cameras aligned to the fitted ones where
    those moved, then each fitted to its photo.
    """
    capture = load(data, one)
    seconds = 0.0

    def progress(now: Any) -> None:
        nonlocal seconds
        seconds = now.seconds

    splats, moved = fit_with_cameras(
        capture, backend=one.backend, seed=one.seed, preset=one.preset, progress=progress
    )
    scores = evaluate(splats, capture, backend=one.backend)
    return {
        **vars(one),
        **{name: scores[name] for name in SCORES},
        **({"psnr_refined": _refined_psnr(splats, capture, moved, one.backend)} if refined else {}),
        "splats": len(splats),
        "seconds": round(seconds, 2),
        "protocol": scores["protocol"],
    }


def _refined_psnr(splats: Splats, given: Capture, moved: Capture, backend: FitBackend) -> float:
    to_fitted = similarity_between(
        [view.camera for view in given.train_views], [view.camera for view in moved.train_views]
    )
    aligned = [replace(v, camera=to_fitted.camera(v.camera)) for v in given.test_views]
    background = default_background(given)
    views = refine_cameras(splats, aligned, background, backend=backend)
    refined = Capture(given.path, views, None)
    return float(evaluate(splats, refined, background=background, backend=backend)["psnr"])


def fitted(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    load: Load,
    photos: dict[tuple[str, str], int],
    presets: tuple[Preset, ...],
    seeds: int,
    backend: FitBackend,
    jobs: int,
    on_run: Callable[[int, int, dict[str, Any]], None] | None,
    ray: bool,
    refined: bool = False,
) -> list[dict[str, Any]]:
    """The rows of all fits; seeds go last, so that a study cut short has all its kinds of fits.

    Args:
        data: folder that holds the scenes.
        out: the study's folder; a fit whose file is in its ``runs/`` is not done again.
        load: gives the capture of a fit.
        photos: number of photos fitted, by (scene, views).
        presets, seeds, backend: every preset is fitted with seeds from 0.
        jobs: fits at a time, each in a process of its own.
        on_run: called with (done, all, the fit's row) after each fit.
        ray: fits run over a Ray cluster instead.
        refined: also score test views with refined cameras.

    Raises:
        IgsrError: a number is not at least 1, there is no such preset, or a fit fails.
    """
    if seeds < 1 or jobs < 1:
        raise IgsrError("seeds and jobs must be at least 1.")
    fits = [
        Fit(scene, views, preset, seed, backend)
        for seed in range(seeds)
        for scene, views in photos
        for preset in presets
    ]
    tasks = [
        Run(
            f"{one.scene}-views{one.views}-{one.preset}-seed{one.seed}-{one.backend}",
            one,
            preset_settings(one.preset, photos[one.scene, one.views])
            | ({"refined": True} if refined else {}),
            scene=one.scene,
        )
        for one in fits
    ]
    work = partial(run_fit, load, refined=True) if refined else partial(run_fit, load)
    return finished_runs(Path(out) / "runs", tasks, work, str(data), jobs, on_run, ray)
