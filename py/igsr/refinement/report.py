"""Files of a refinement: models, added views, ``report.json`` and ``report.html``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import Backend
from igsr._internal.input_files import read_json
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Usage, total
from igsr.capture import View
from igsr.evaluation.contact_sheet import contact_sheet, rounds_sheet, save_sheet, sheet_names
from igsr.evaluation.limits import limit_of
from igsr.evaluation.quick_scores import mean_of, quick_views, train_photos, train_scores
from igsr.evaluation.scores import ScoredView, default_background
from igsr.fitting.fit_report import photo_counts
from igsr.fitting.scene_files import write_scene
from igsr.refinement.html_page import write_page
from igsr.refinement.results import Refined, Round, Stage
from igsr.refinement.selection import Candidate, Rejected
from igsr.refinement.settings import RefineSettings
from igsr.run import Run
from igsr.splats import Splats

#: Format number of ``report.json``.
FORMAT = 4
#: Files of a round.
ROUND_FILES = ("scene.ply", "view-*.before.png", "view-*.after.png", "view-*.confidence.png")


def write_refinement(run: Run, refined: Refined, settings: RefineSettings) -> None:
    """Write the files of a refinement so far.

    * ``scene.ply``: the last model; ``cameras.json``: the photos' cameras.
    * ``rounds/N/scene.ply``: the model of each round; 0 is the fit to the photos alone.
    * ``rounds/N/view-K.{before,after,confidence}.png``: the novel views that the round added:
      renders, denoised renders and confidence weights (white is 1).
    * ``views.png``: test views, or fitted photos if there are none, before the first round and
      after the last; without a round, photos, renders and errors.

    Such files of an earlier run are removed. Scores of fitted photos are computed only at the end.

    Raises:
        IgsrError: a file cannot be written.
    """
    assert run.out is not None
    out = run.out
    written = [_save(refined.first, out / "rounds" / "0" / "scene.ply")]
    for number, done in enumerate(refined.rounds, 1):
        folder = out / "rounds" / str(number)
        written.append(_save(done.splats, folder / "scene.ply"))
        for k, candidate in enumerate(done.selected):
            written += _write_view(folder, k, candidate)
    _remove_others(out / "rounds", set(written))
    background = default_background(refined.capture)
    write_scene(run, refined.splats, refined.capture, background, refined.models())
    train, shown = _scored(refined, settings.backend)
    report = report_of(refined, settings, run.parts.used, train)
    write_json(out / "report.json", report)
    _write_views(out / "views.png", refined, shown, settings.backend)
    write_page(out / "report.html", refined, report, shown)


def report_of(
    refined: Refined,
    settings: RefineSettings,
    parts: Mapping[str, Usage] | None = None,
    train: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Make the content of ``report.json``.

    Args:
        refined: the refinement.
        settings: of the refinement.
        parts: time and memory of each stage.
        train: "psnr", "ssim", "views" and "of" of fitted photos, if they are scored.
    """
    test = [refined.first_test, *(done.test for done in refined.rounds)][-1]
    limit = None
    if train is not None:
        limit = limit_of(train["psnr"], None if test is None else test["psnr"]).plain()
    used = {} if parts is None else {name: usage.plain() for name, usage in parts.items()}
    first = {"splats": len(refined.first), "test": refined.first_test}
    return {
        "format": FORMAT,
        "rounds": [first, *map(_round_row, refined.rounds)],
        "stop_reason": None if refined.stop is None else refined.stop.reason.value,
        "stopped": "" if refined.stop is None else str(refined.stop),
        "rejected": _view_rows(refined.rejected),
        "seconds": round(sum(refined.seconds.values()), 3),
        "parts": used,
        "peak_memory_bytes": total(used).peak_memory_bytes,
        "test": test,
        "train": train,
        "limit": limit,
        "photos": photo_counts(refined.capture, refined.not_placed),
        "splats": len(refined.splats),
        "settings": vars(settings),
        "seed": settings.seed,
        "version": _core.__version__,
        **_core.backend_info(_core.resolve_backend(settings.backend)),
    }


def parts_so_far(out: Path) -> dict[str, Usage]:
    """Read the time and memory of each stage from the report in ``out``; {} if there is none."""
    try:
        found = read_json(out / "report.json")["parts"]
        return {stage: Usage.of(found[stage]) for stage in get_args(Stage) if stage in found}
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return {}


def _round_row(done: Round) -> dict[str, Any]:
    return {
        "splats": len(done.splats),
        "test": done.test,
        "candidates": len(done.selected) + len(done.rejected),
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


def _scored(refined: Refined, backend: Backend) -> tuple[dict[str, Any] | None, list[ScoredView]]:
    """Scores of fitted photos, None before the end, and the views to show."""
    capture = refined.capture
    background = default_background(capture)

    def quick(views: Sequence[View]) -> list[ScoredView]:
        return list(quick_views(refined.splats, views, background, backend))

    if capture.test_views:
        names = sheet_names([view.name for view in capture.test_views])
        shown = quick([view for view in capture.test_views if view.name in names])
        if refined.stop is None:
            return None, shown
        return train_scores(refined.splats, capture, background, backend), shown
    fitted = quick(train_photos(capture))
    names = sheet_names([one.name for one in fitted])
    shown = [one for one in fitted if one.name in names]
    if refined.stop is None:
        return None, shown
    return mean_of(fitted, len(capture.train_views)), shown


def _write_views(path: Path, refined: Refined, shown: list[ScoredView], backend: Backend) -> None:
    """Write ``views.png``."""
    if not refined.rounds:
        save_sheet(path, contact_sheet(shown))
        return
    names = {one.name for one in shown}
    capture = refined.capture
    views = [v for v in capture.test_views or capture.train_views if v.name in names]
    before = quick_views(refined.first, views, default_background(capture), backend)
    save_sheet(path, rounds_sheet(list(before), shown))


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
