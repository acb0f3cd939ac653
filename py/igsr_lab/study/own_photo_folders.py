"""Photos as people have them, end to end: cameras, fit and scores, and two presets compared."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.choices import FitBackend
from igsr._internal.part_usage import total
from igsr._internal.resumable_jobs import Run, file_hash, finished_runs
from igsr._internal.worker_processes import in_a_process
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import photo_sizes
from igsr.errors import IgsrError
from igsr.evaluation.quick_scores import MAX_TRAIN_PHOTOS
from igsr.fitting.presets import Preset, default_max_size, preset_settings
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.study.own_photos_runs import (
    CameraRun,
    OwnFit,
    find_scene_cameras,
    fit_and_score,
)
from igsr_lab.study.own_photos_tables import write_report
from igsr_lab.study.photo_scenes import file_name, photo_scenes
from igsr_lab.study.splits import HOLDOUT

#: Photos are scored at this size at most where presets may fit at sizes of their own, pixels.
SCORE_SIZE = 1600
#: Of cameras: they are found once, whatever the seeds of the fits.
ESTIMATOR = "auto"


def own_photos(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: tuple[str, ...] | None = None,
    preset: Preset = "default",
    compare: Preset | None = None,
    seeds: int = 3,
    holdout: int = HOLDOUT,
    steps: int | None = None,
    max_size: int | None = None,
    score_size: int | None = None,
    known_cameras: bool = False,
    features: str | os.PathLike[str] | None = None,
    left_half: bool = False,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Run folders of plain photos end to end, as ``igsr fit`` does, and score what comes out.

    Cameras of a scene are found once, with seed 0, and kept in ``out``; their seconds count in
    each row. Cameras and each fit run in a process of their own, so that peak memory is theirs.

    Args:
        data: a folder of photos, or of such folders; a folder with ``images/`` is one, too.
        out: folder for ``study.json``, ``study.md``, ``study.png``, ``runs/`` with a file per fit,
            ``cameras/``, ``splats/`` and ``sheets/``; a fit whose file is there is not done again.
        scenes: names of folders in ``data``; None takes all with photos.
        preset: a name of ``igsr.fitting.presets``.
        compare: another, which comes before; differences are ``preset`` minus this one.
        seeds: how many seeds, from 0.
        holdout: every so many photos one is held out, counted in the order of their names.
        steps: of each fit; None is the preset's number.
        max_size: longest side of the photos that are fitted, pixels; None is what
            ``default_max_size`` says of the backend.
        score_size: longest side of the photos that are scored, pixels, the same for all presets;
            None is ``max_size``, or 1600 where that is None.
        known_cameras: use cameras that lie beside the photos, where there are some.
        features: SqueezeNet's arrays (.npz), to score a perceptual distance as well.
        left_half: score held-out photos' right halves, too, with the exposure that is found on
            their left halves (``igsr_lab.study.left_half``).
        backend: what fits and renders.
        jobs: runs at a time, each with its share of the cores.
        on_run: called with (done, all, row) after the cameras of a scene, and after each fit.

    Returns:
        What ``study.json`` holds: "runs", a row per scene, preset and seed; "cameras", a row per
        scene; "scenes" and "mean" with means and spreads; "differences" where two presets are
        compared (see ``igsr_lab.study.own_photos_tables``).

    Raises:
        IgsrError: there are no photos, an argument cannot be used, or a fit fails. Where only the
            cameras of a scene cannot be found, the study goes on without it, and says so.
    """
    sizes = {"max_size": max_size, "score_size": score_size, "steps": steps}
    for name, number in {"seeds": seeds, "jobs": jobs, **sizes}.items():
        if number is not None and number < 1:
            raise IgsrError(f"{name} must be at least 1, not {number}.")
    if holdout < 2:
        raise IgsrError(f"holdout must be at least 2, such as {HOLDOUT}, not {holdout}.")
    presets = (preset,) if compare is None else (compare, preset)
    if len(set(presets)) < len(presets):
        raise IgsrError(f"compare is {compare!r}, as preset; name another, or leave it out.")
    for name in presets:
        preset_settings(name, 1)
    if features is not None:
        SqueezeNetDistance(features)
    root, names = photo_scenes(Path(data), scenes)
    folder = Path(out)
    for name in names:
        inside = (root / name).resolve()
        if inside in (folder.resolve(), *folder.resolve().parents):
            raise IgsrError(f"{out} lies in {root / name}, a scene; name another --out.")

    # Cameras first: a scene's are the same for all of its fits.
    own = {name for name in names if known_cameras and holds_cameras(root / name)}
    score_size = score_size or max_size or SCORE_SIZE
    if max_size is None:
        max_size = default_max_size(backend)
    most = max(score_size, max_size)
    tasks = [_camera_task(folder, name, most) for name in names if name not in own]
    work = partial(in_a_process, find_scene_cameras)
    cameras = {
        row["scene"]: row
        for row in finished_runs(folder / "cameras", tasks, work, str(root), jobs, on_run)
    }
    failed = {name: row["failed"] for name, row in cameras.items() if row["failed"]}
    fits = [
        OwnFit(
            name,
            one,
            seed,
            backend,
            holdout,
            steps,
            max_size,
            score_size,
            None if features is None else str(features),
            left_half,
            None if name in own else str(_cameras(folder, name)),
            str(folder / "splats" / f"{_run_name(name, one, seed, backend)}.ply"),
            str(folder / "sheets" / f"{file_name(name)}-{one}.png") if seed == 0 else None,
        )
        for seed in range(seeds)
        for name in names
        if name not in failed
        for one in presets
    ]
    digest = None if features is None else file_hash(Path(features))
    rows = finished_runs(
        folder / "runs",
        [_fit_task(root, one, cameras.get(one.scene), digest) for one in fits],
        partial(in_a_process, fit_and_score),
        str(root),
        jobs,
        on_run,
    )
    protocol = {
        "name": "own-photos",
        "holdout": holdout,
        "seeds": seeds,
        "steps": steps,
        "max_size": max_size,
        "score_size": score_size,
        "cameras": "known where there are some, else found" if known_cameras else "found",
        "train": f"at most {MAX_TRAIN_PHOTOS} fitted photos of each scene, evenly spaced",
        "refined": "held-out cameras aligned to the fitted ones where those moved, then each "
        "fitted to its photo, splats frozen",
        "backend": _core.backend_info(backend),
    }
    return write_report(
        folder, [_whole(row, cameras.get(row["scene"])) for row in rows], cameras, presets, protocol
    )


def _cameras(out: Path, scene: str) -> Path:
    return out / "cameras" / f"{file_name(scene)}.npz"


def _run_name(scene: str, preset: str, seed: int, backend: str) -> str:
    return f"{file_name(scene)}-{preset}-seed{seed}-{backend}"


def _camera_task(out: Path, scene: str, max_size: int) -> Run:
    cameras = _cameras(out, scene)
    return Run(
        file_name(scene),
        CameraRun(scene, str(cameras), ESTIMATOR, max_size),
        {"estimator": ESTIMATOR},
        leaves=cameras,
        scene=scene,
    )


def _fit_task(root: Path, one: OwnFit, cameras: dict[str, Any] | None, features: str | None) -> Run:
    placed = len(photo_sizes(root / one.scene)) if cameras is None else cameras["placed"]
    photos = placed - len(range(0, placed, one.holdout))
    settings = {
        **preset_settings(one.preset, photos, steps=one.steps),
        "holdout": one.holdout,
        "max_size": one.max_size,
        "scored_at": one.score_size,
        "perceptual": features,
        **({"left_half": True} if one.left_half else {}),
        "cameras": None if one.cameras is None else file_hash(Path(one.cameras)),
    }
    name = _run_name(one.scene, one.preset, one.seed, one.backend)
    leaves = None if one.sheet is None else Path(one.sheet)
    return Run(name, one, settings, leaves=leaves, scene=one.scene)


def _whole(row: dict[str, Any], cameras: dict[str, Any] | None) -> dict[str, Any]:
    """A fit's row with what its scene's cameras took, and sums over all parts."""
    parts = {**(cameras["parts"] if cameras is not None else {}), **row["parts"]}
    placed = row["train_photos"] + len(row["views"])
    whole = total(parts)
    return {
        **row,
        "photos": placed if cameras is None else cameras["photos"],
        "placed": placed,
        "parts": parts,
        "seconds": round(whole.seconds, 3),
        "cpu_seconds": round(whole.cpu_seconds, 3),
        "peak_memory_bytes": whole.peak_memory_bytes,
    }
