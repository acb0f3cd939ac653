"""``own_photos``: plain photos from cameras to scores, and two presets compared."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.part_usage import total
from igsr._internal.worker_processes import in_a_process
from igsr.capture.image_files import SUFFIXES
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import file_sizes
from igsr.errors import IgsrError
from igsr.evaluation.quick_scores import MAX_TRAIN_PHOTOS
from igsr.fitting.presets import default_max_size
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.presets import Preset, preset_settings
from igsr_lab.resumable_jobs import Run, file_hash
from igsr_lab.study.own_photos_report import write_report
from igsr_lab.study.own_photos_runs import (
    CameraRun,
    OwnFit,
    find_scene_cameras,
    fit_and_score,
)
from igsr_lab.study.preset_fits import REFINED
from igsr_lab.study.splits import HOLDOUT
from igsr_lab.study.study import Row, Study

#: Default longest side of scored photos, if neither longest side is given.
SCORE_SIZE_PX = 1600


def own_photos(
    study: Study,
    *,
    scenes: tuple[str, ...] | None = None,
    preset: Preset = "default",
    compare: Preset | None = None,
    holdout: int = HOLDOUT,
    steps: int | None = None,
    max_size: int | None = None,
    score_size: int | None = None,
    known_cameras: bool = False,
    features: Path | None = None,
    left_half: bool = False,
) -> Row:
    """Find cameras, fit and score folders of plain photos as ``igsr fit`` does.

    Cameras of a scene are found once, with seed 0, and kept; their time counts in each row. Cameras
    and each fit run in their own process, so that peak memory is theirs.

    Args:
        study: its data is a folder of photos, or of such folders; photos may be in ``images/``.
            Its folder also gets ``cameras/``, ``splats/`` and ``sheets/``.
        scenes: names of folders in the data; None is all with photos.
        preset: a name of ``PRESETS``.
        compare: another preset, as the baseline; differences are ``preset`` minus this one.
        holdout: hold out every Nth photo, sorted by name.
        steps: of each fit; None is the preset's.
        max_size: longest side of fitted photos in pixels; None is ``default_max_size``.
        score_size: longest side of scored photos in pixels; None is ``max_size``, or 1600.
        known_cameras: use the cameras of scenes that have some.
        features: SqueezeNet's arrays (.npz), to score a perceptual distance, too.
        left_half: also score right halves of held-out photos, with the exposure that fits their
            left halves (``igsr_lab.study.left_half``).

    Returns:
        The content of ``study.json``: "runs", a row per scene, preset and seed; "cameras", a row
        per scene; "scenes" and "mean" with means and spreads; "differences" of two presets (see
        ``igsr_lab.study.own_photos_report``).
    """
    for name, number in (("max_size", max_size), ("score_size", score_size), ("steps", steps)):
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
    root, names = photo_scenes(study.data, scenes)
    out = study.out
    for name in names:
        inside = (root / name).resolve()
        if inside in (out.resolve(), *out.resolve().parents):
            raise IgsrError(f"{out} is inside the scene {root / name}; name another --out.")

    own = {name for name in names if known_cameras and holds_cameras(root / name)}
    score_size = score_size or max_size or SCORE_SIZE_PX
    max_size = default_max_size(study.backend) if max_size is None else max_size
    study = Study(root, out, study.seeds, study.backend, study.jobs, study.on_run)
    camera_runs = [
        _camera_run(out, name, max(score_size, max_size)) for name in names if name not in own
    ]
    found = study.rows(camera_runs, partial(in_a_process, find_scene_cameras), "cameras")
    cameras = {row["scene"]: row for row in found}
    failed = {name for name, row in cameras.items() if row["failed"]}
    fits = [
        OwnFit(
            name,
            one,
            seed,
            study.backend,
            holdout,
            steps,
            max_size,
            score_size,
            None if features is None else str(features),
            left_half,
            None if name in own else str(_cameras_file(out, name)),
            str(out / "splats" / f"{_run_name(name, one, seed, study.backend)}.ply"),
            str(out / "sheets" / f"{file_name(name)}-{one}.png") if seed == 0 else None,
        )
        for seed in range(study.seeds)
        for name in names
        if name not in failed
        for one in presets
    ]
    fit_runs = [_fit_run(root, fit, cameras.get(fit.scene)) for fit in fits]
    rows = study.rows(fit_runs, partial(in_a_process, fit_and_score))
    protocol = {
        "name": "own-photos",
        "holdout": holdout,
        "seeds": study.seeds,
        "steps": steps,
        "max_size": max_size,
        "score_size": score_size,
        "cameras": "known if there are some, else found" if known_cameras else "found",
        "train": f"at most {MAX_TRAIN_PHOTOS} fitted photos of each scene, evenly spaced",
        "refined": REFINED,
        "backend": _core.backend_info(study.backend),
    }
    whole = [_with_cameras(row, cameras.get(row["scene"])) for row in rows]
    return write_report(study, whole, cameras, presets, protocol)


def photo_scenes(data: Path, names: Sequence[str] | None = None) -> tuple[Path, list[str]]:
    """Find the scenes in a folder.

    Args:
        data: a folder of photos, or of such folders.
        names: scenes as paths relative to ``data``; None is all folders directly in it, or
            ``data`` itself if it has photos.

    Returns:
        The folder that the names are relative to, and the names.
    """
    if not data.is_dir():
        raise IgsrError(f"{data} does not exist or is not a folder; give a folder of photos")
    if names is None:
        if _has_photos(data):
            whole = data.resolve()
            return whole.parent, [whole.name]
        found = sorted(folder.name for folder in data.iterdir() if _has_photos(folder))
        if not found:
            raise IgsrError(
                f"{data} holds no photos and no folder with photos; give one, or name --scene"
            )
        return data, found
    for name in names:
        if not _has_photos(data / name):
            raise IgsrError(f"{data / name} holds no photos; name another --scene")
    files = [file_name(name) for name in names]
    double = [name for k, name in enumerate(names) if files[k] in files[:k]]
    if double:
        raise IgsrError(f"--scene {double[0]} is named twice; name it once")
    return data, list(names)


def _has_photos(folder: Path) -> bool:
    return any(
        path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
        for place in (folder, folder / "images")
        if place.is_dir()
        for path in place.iterdir()
    )


def file_name(scene: str) -> str:
    """A scene's name as part of a file's name."""
    return scene.strip("/").replace("/", "-")


def _cameras_file(out: Path, scene: str) -> Path:
    return out / "cameras" / f"{file_name(scene)}.npz"


def _run_name(scene: str, preset: str, seed: int, backend: str) -> str:
    return f"{file_name(scene)}-{preset}-seed{seed}-{backend}"


def _camera_run(out: Path, scene: str, max_size: int) -> Run:
    cameras = _cameras_file(out, scene)
    run = CameraRun(scene, str(cameras), max_size)
    return Run(file_name(scene), run, {}, leaves=cameras, scene=scene)


def _fit_run(root: Path, fit: OwnFit, cameras: Row | None) -> Run:
    placed = len(file_sizes(root / fit.scene)) if cameras is None else cameras["placed"]
    photos = placed - len(range(0, placed, fit.holdout))
    settings: dict[str, Any] = {
        **preset_settings(fit.preset, photos, steps=fit.steps),
        "holdout": fit.holdout,
        "max_size": fit.max_size,
        "scored_at": fit.score_size,
        "perceptual": None if fit.features is None else file_hash(Path(fit.features)),
        "left_half": fit.left_half,
        "cameras": None if fit.cameras is None else file_hash(Path(fit.cameras)),
    }
    name = _run_name(fit.scene, fit.preset, fit.seed, fit.backend)
    leaves = None if fit.sheet is None else Path(fit.sheet)
    return Run(name, fit, settings, leaves=leaves, scene=fit.scene)


def _with_cameras(row: Row, cameras: Row | None) -> Row:
    """Add the time of finding cameras to a fit's row, and sums over all parts."""
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
