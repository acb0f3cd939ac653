"""What a refinement leaves: models, chosen views, ``report.json`` and ``report.html``."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.json_file import write_json
from igsr.capture.write_cameras import write_cameras
from igsr.evaluation.contact_sheet import rounds_sheet, save_sheet, sheet_names
from igsr.evaluation.scores import default_background, score_views
from igsr.pose import not_placed
from igsr.refinement.html_page import write_page
from igsr.splats import Splats

if TYPE_CHECKING:
    from igsr.refinement.results import Refined, Round
    from igsr.refinement.selection import Candidate, Passed

#: Parts of a refinement, as ``RefineProgress.doing`` has them.
PARTS = ("fit", "look", "judge", "refit", "test")


def write_refinement(out: Path, refined: Refined, backend: str, seed: int) -> None:
    """Write a refinement as it stands.

    ``scene.ply`` is the last accepted model, ``cameras.json`` has the photos' cameras.
    ``rounds/N/scene.ply`` is each round's, 0 the fit to the photos alone;
    ``rounds/N/view-K.{before,after,trust}.png`` are the views that it added, the trust white where
    a pixel counts most. Such files of an earlier run that this one does not write are removed.
    ``views.png`` has test views before the first round and after the last, if there is one.

    Raises:
        IgsrError: a file cannot be written.
    """
    rows = [{"splats": len(refined.first), "test": refined.first_test}]
    written = [_save(refined.first, out / "rounds" / "0" / "scene.ply")]
    for number, one in enumerate(refined.rounds, 1):
        folder = out / "rounds" / str(number)
        rows.append(_row(one))
        if one.splats is not None:
            written.append(_save(one.splats, folder / "scene.ply"))
        for k, candidate in enumerate(one.chosen):
            written += _write_view(folder, k, candidate)
    _remove_others(out / "rounds", set(written))
    refined.splats.save(out / "scene.ply")
    write_cameras(out / "cameras.json", refined.capture.train_views)
    report = {
        "rounds": rows,
        "stopped": refined.stopped,
        "passed": [*map(_numbers, refined.passed)],
        "seconds": {part: round(seconds, 2) for part, seconds in refined.seconds.items()},
        "peak_memory_bytes": _peak_memory(),
        "photos": [view.name for view in refined.capture.train_views],
        "not_placed": not_placed(refined.capture),
        "splats": len(refined.splats),
        "seed": seed,
        "version": _core.__version__,
        **_core.backend_info(_core.resolve_backend(backend)),
    }
    write_json(out / "report.json", report)
    _write_views(out / "views.png", refined, backend)
    write_page(out / "report.html", refined, report)


def seconds_so_far(out: Path) -> dict[str, float]:
    """What each part took by the report that lies in ``out``; none where there is no such."""
    try:
        found = json.loads((out / "report.json").read_text(encoding="utf-8"))["seconds"]
        seconds = {part: float(found[part]) for part in PARTS if part in found}
        return {part: value for part, value in seconds.items() if 0.0 <= value < math.inf}
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return {}


def _write_views(path: Path, refined: Refined, backend: str) -> None:
    """Test views before the first round and after the last that was accepted."""
    shown = sheet_names([view.name for view in refined.capture.test_views])
    views = [view for view in refined.capture.test_views if view.name in shown]
    if not views or not any(one.accepted for one in refined.rounds):
        path.unlink(missing_ok=True)
        return
    background = default_background(refined.capture)
    before, after = (
        list(score_views(splats, views, background, backend))
        for splats in (refined.first, refined.splats)
    )
    save_sheet(path, rounds_sheet(before, after))


def _row(one: Round) -> dict[str, Any]:
    return {
        "splats": None if one.splats is None else len(one.splats),
        "test": one.test,
        "accepted": one.accepted,
        "candidates": len(one.chosen) + len(one.passed),
        "left_out": {"before": one.before, "with": one.left_out},
        "views": [*map(_numbers, one.chosen)],
        "passed": [*map(_numbers, one.passed)],
    }


def _numbers(one: Candidate | Passed) -> dict[str, Any]:
    return {
        "angle": round(one.view.angle, 2),
        "between": one.view.between,
        "mean_trust": round(one.mean_trust, 4),
        "worth": round(one.worth, 6),
    }


def _save(splats: Splats, path: Path) -> Path:
    splats.save(path)
    return path


def _write_view(folder: Path, k: int, one: Candidate) -> list[Path]:
    trust = np.rint(255.0 * np.clip(one.trust, 0.0, 1.0)).astype(np.uint8)
    pictures: dict[str, npt.NDArray[np.uint8]] = {
        "before": one.render,
        "after": one.picture,
        "trust": trust,
    }
    paths = [folder / f"view-{k}.{name}.png" for name in pictures]
    for path, picture in zip(paths, pictures.values(), strict=True):
        with atomic_write(path) as temporary:
            Image.fromarray(picture).save(temporary, format="PNG")
    return paths


def _remove_others(rounds: Path, written: set[Path]) -> None:
    """Remove the models and views of an earlier run's rounds, and no other file."""
    for pattern in ("scene.ply", "view-*.before.png", "view-*.after.png", "view-*.trust.png"):
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
