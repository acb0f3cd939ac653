"""What a refinement leaves: models, added views, ``report.json`` and ``report.html``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import Backend
from igsr._internal.json_file import write_json
from igsr.capture.write_cameras import write_cameras
from igsr.evaluation.contact_sheet import rounds_sheet, save_sheet, sheet_names
from igsr.evaluation.scores import default_background, score_views
from igsr.pose import not_placed
from igsr.refinement.html_page import write_page
from igsr.refinement.results import OLD_STAGES, Refined, Round, Stage
from igsr.refinement.selection import Candidate, Rejected
from igsr.refinement.settings import RefineSettings
from igsr.splats import Splats

#: Of ``report.json``. Format 1 had no number, other keys, and no settings.
FORMAT = 2
#: Files of a round; ``trust`` is what igsr 0.1 called the confidence weights.
ROUND_FILES = (
    "scene.ply",
    "view-*.before.png",
    "view-*.after.png",
    "view-*.confidence.png",
    "view-*.trust.png",
)


def write_refinement(out: Path, refined: Refined, settings: RefineSettings) -> None:
    """Write a refinement as it stands.

    ``scene.ply`` is the last accepted model, ``cameras.json`` has the photos' cameras.
    ``rounds/N/scene.ply`` is each round's model, 0 the fit to the photos alone;
    ``rounds/N/view-K.{before,after,confidence}.png`` are the novel views that it added: rendered,
    denoised, and their confidence weights, white for 1. Such files of an earlier run that this one
    does not write are removed. ``views.png`` has test views before the first round and after the
    last accepted one.

    Raises:
        IgsrError: a file cannot be written.
    """
    written = [_save(refined.first, out / "rounds" / "0" / "scene.ply")]
    for number, done in enumerate(refined.rounds, 1):
        folder = out / "rounds" / str(number)
        if done.splats is not None:
            written.append(_save(done.splats, folder / "scene.ply"))
        for k, candidate in enumerate(done.selected):
            written += _write_view(folder, k, candidate)
    _remove_others(out / "rounds", set(written))
    refined.splats.save(out / "scene.ply")
    write_cameras(out / "cameras.json", refined.capture.train_views)
    report = report_of(refined, settings)
    write_json(out / "report.json", report)
    _write_views(out / "views.png", refined, settings.backend)
    write_page(out / "report.html", refined, report)


def report_of(refined: Refined, settings: RefineSettings) -> dict[str, Any]:
    """What ``report.json`` holds."""
    first = {"splats": len(refined.first), "test": refined.first_test}
    return {
        "format": FORMAT,
        "rounds": [first, *map(_round_row, refined.rounds)],
        "stop_reason": None if refined.stop is None else refined.stop.reason.value,
        "stopped": "" if refined.stop is None else str(refined.stop),
        "rejected": _view_rows(refined.rejected),
        "seconds": {stage: round(seconds, 2) for stage, seconds in refined.seconds.items()},
        "peak_memory_bytes": _peak_memory(),
        "photos": [view.name for view in refined.capture.train_views],
        "not_registered": not_placed(refined.capture),
        "splats": len(refined.splats),
        "settings": vars(settings),
        "seed": settings.seed,
        "version": _core.__version__,
        **_core.backend_info(_core.resolve_backend(settings.backend)),
    }


def seconds_so_far(out: Path) -> dict[Stage, float]:
    """What each stage took by the report in ``out``, of format 1 or 2; none if it has no such."""
    stages: tuple[Stage, ...] = get_args(Stage)
    old_names = {new: old for old, new in OLD_STAGES.items()}
    seconds: dict[Stage, float] = {}
    try:
        found = json.loads((out / "report.json").read_text(encoding="utf-8"))["seconds"]
        for stage in stages:
            name = stage if stage in found else old_names.get(stage, stage)
            if name in found:
                seconds[stage] = float(found[name])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return {}
    return {stage: value for stage, value in seconds.items() if 0.0 <= value < math.inf}


def _round_row(done: Round) -> dict[str, Any]:
    return {
        "splats": None if done.splats is None else len(done.splats),
        "test": done.test,
        "accepted": done.accepted,
        "candidates": len(done.selected) + len(done.rejected),
        "cross_validation": {"before": done.validation_before, "after": done.validation_after},
        "selected": _view_rows(done.selected),
        "rejected": _view_rows(done.rejected),
    }


def _view_rows(views: Sequence[Candidate | Rejected]) -> list[dict[str, Any]]:
    return [
        {
            "angle": round(one.view.angle, 2),
            "between": one.view.between,
            "mean_confidence": round(one.mean_confidence, 4),
            "gain": round(one.gain, 6),
        }
        for one in views
    ]


def _write_views(path: Path, refined: Refined, backend: Backend) -> None:
    """Test views before the first round and after the last that was accepted."""
    shown = sheet_names([view.name for view in refined.capture.test_views])
    views = [view for view in refined.capture.test_views if view.name in shown]
    if not views or not any(done.accepted for done in refined.rounds):
        path.unlink(missing_ok=True)
        return
    background = default_background(refined.capture)
    before, after = (
        list(score_views(splats, views, background, backend))
        for splats in (refined.first, refined.splats)
    )
    save_sheet(path, rounds_sheet(before, after))


def _save(splats: Splats, path: Path) -> Path:
    splats.save(path)
    return path


def _write_view(folder: Path, k: int, candidate: Candidate) -> list[Path]:
    confidence = np.rint(255.0 * np.clip(candidate.confidence, 0.0, 1.0)).astype(np.uint8)
    pictures: dict[str, npt.NDArray[np.uint8]] = {
        "before": candidate.render,
        "after": candidate.denoised,
        "confidence": confidence,
    }
    paths = [folder / f"view-{k}.{name}.png" for name in pictures]
    for path, picture in zip(paths, pictures.values(), strict=True):
        with atomic_write(path) as temporary:
            Image.fromarray(picture).save(temporary, format="PNG")
    return paths


def _remove_others(rounds: Path, written: set[Path]) -> None:
    """Remove the models and views of an earlier run's rounds, and no other file."""
    for pattern in ROUND_FILES:
        for path in rounds.glob(f"[0-9]*/{pattern}"):
            if path not in written:
                path.unlink()
    for folder in rounds.glob("[0-9]*"):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _peak_memory() -> int | None:
    """Most bytes that this process has had in memory; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
