"""The report of a fit: ``report.json``, ``report.html`` and ``views.png``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.event import Event
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import total
from igsr.capture import Capture
from igsr.evaluation.contact_sheet import contact_sheet, save_sheet, sheet_names
from igsr.evaluation.limits import limit_of
from igsr.evaluation.quick_scores import train_photos, train_scores
from igsr.evaluation.scores import METRICS, ScoredView, Scores, default_split, evaluate
from igsr.evaluation.shared_points import placed_by
from igsr.fitting.fit_page import write_fit_page
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.presets import chosen_keywords
from igsr.fitting.result import FitResult
from igsr.run import Run
from igsr.splats import Splats

Color = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class FitScores:
    """Scores of a fit.

    Attributes:
        scores: of held-out photos; of fitted ones (``train_photos``) if none is held out.
        shown: the scored views that ``views.png`` and ``report.html`` show.
        train: "psnr", "ssim", "views" and "of" of fitted photos.
        refined: mean scores of held-out photos with cameras fitted to them, or None.
    """

    scores: Scores
    shown: list[ScoredView]
    train: dict[str, Any]
    refined: dict[str, float | None] | None = None


def score_fit(result: FitResult, background: Color, run: Run, *, refined: bool) -> FitScores:
    """Score held-out and fitted photos.

    Args:
        result: the fit.
        background: RGB in [0, 1] behind renders and photos with alpha.
        run: reports progress.
        refined: whether to score held-out photos with cameras fitted to them, too: the given ones
            may be as wrong as those that were found or optimized.

    Raises:
        IgsrError: a mask leaves no pixel to score.
    """
    splats, capture = result.splats, result.capture
    backend: Any = result.device["backend"]
    if default_split(capture) == "train":
        some = Capture(capture.path, train_photos(capture))
        scores, shown = _scored(splats, some, background, backend, run)
        count = len(capture.train_views)
        if len(some.views) < count:
            scores.protocol["of"] = count
        train = {"psnr": scores.psnr, "ssim": scores.ssim, "views": len(some.views), "of": count}
        return FitScores(scores, shown, train)
    scores, shown = _scored(splats, capture, background, backend, run)
    train = train_scores(splats, capture, background, backend)
    if not refined:
        return FitScores(scores, shown, train)
    views = refine_cameras(
        splats, capture.test_views, background, backend=backend, progress=run.report
    )
    again, _ = _scored(splats, replace(capture, views=views), background, backend, run)
    return FitScores(scores, shown, train, {metric: again[metric] for metric in METRICS})


def _scored(
    splats: Splats, capture: Capture, background: Color, backend: Any, run: Run
) -> tuple[Scores, list[ScoredView]]:
    split = default_split(capture)
    views = capture.test_views if split == "test" else capture.train_views
    wanted = sheet_names([view.name for view in views])
    shown: list[ScoredView] = []
    done = 0

    def on_view(scored: ScoredView) -> None:
        nonlocal done
        done += 1
        run.report(Event("score", done, len(views)))
        if scored.name in wanted:
            shown.append(scored)

    return evaluate(splats, capture, split, background, backend, on_view), shown


def fit_report(
    result: FitResult, scored: FitScores, run: Run, asked: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the content of ``report.json``.

    Args:
        result: the fit.
        scored: its scores.
        run: measured the parts.
        asked: arguments of the run.
    """
    scores = scored.scores
    held_out = scores.psnr if scores.protocol["split"] == "test" else None
    refined = None if scored.refined is None else scored.refined["psnr"]
    parts = run.parts.plain()
    return {
        **{metric: scores[metric] for metric in METRICS},
        **({} if scored.refined is None else {"refined": scored.refined}),
        "train": scored.train,
        "limit": limit_of(scored.train["psnr"], held_out, refined).plain(),
        "splats": len(result.splats),
        **chosen_keywords(result.settings),
        "removed": dict(result.removed),
        "masked": {name: round(part, 5) for name, part in result.masked.items()},
        "start": result.started[0],
        "start_splats": result.started[1],
        "seconds": round(result.seconds, 3),
        "parts": parts,
        "peak_memory_bytes": total(parts).peak_memory_bytes,
        "exposures": {name: exposure.plain() for name, exposure in result.exposures.items()},
        "photos": photo_counts(result.capture, result.not_placed),
        **result.device,
        "seed": result.settings.seed,
        "version": _core.__version__,
        "capture": asked["capture"],
        "settings": dict(asked),
        "protocol": scores.protocol,
        "views": scores.views,
    }


def photo_counts(capture: Capture, not_placed: Sequence[str]) -> dict[str, Any]:
    """Numbers of photos by their use, the names of those without a camera, and what placed others.

    "placed_by" has the points of each photo if the capture has tracks; see ``placed_by``.
    """
    tracks = None if capture.points is None else capture.points.tracks
    return {
        "given": len(capture.views) + len(not_placed),
        "placed": len(capture.views),
        "train": len(capture.train_views),
        "test": len(capture.test_views),
        "not_placed": list(not_placed),
        "placed_by": {} if tracks is None else placed_by(tracks),
    }


def write_fit_report(
    out: Path, report: dict[str, Any], result: FitResult, scored: FitScores
) -> None:
    """Write ``views.png``, ``report.json`` and ``report.html``.

    Raises:
        IgsrError: a file cannot be written.
    """
    save_sheet(out / "views.png", contact_sheet(scored.shown))
    write_json(out / "report.json", report)
    write_fit_page(out / "report.html", report, result.splats, result.capture, scored.shown)
