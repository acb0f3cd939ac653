"""What ``igsr fit`` leaves beside the splats: ``report.json``, ``views.png``, ``report.html``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Parts, total
from igsr.capture import Capture
from igsr.capture.write_transforms import write_cameras
from igsr.evaluation.contact_sheet import contact_sheet, save_sheet
from igsr.evaluation.limits import limit_of
from igsr.evaluation.scores import METRICS, ScoredView, Scores
from igsr.fitting.fit_page import write_fit_page
from igsr.fitting.presets import preset_keywords
from igsr.fitting.run import Progress
from igsr.fitting.settings import FitSettings
from igsr.splats import Splats


@dataclass(frozen=True, eq=False)
class FinishedFit:
    """A fit that is done.

    Attributes:
        splats: the scene.
        capture: the photos, train cameras as they were fitted.
        settings: of the fit.
        asked: all options of the run, for ``report.json``; "preset", "backend" and "capture" among
            them.
        last: the last progress of the fit.
        not_placed: names of photos whose cameras were not found.
    """

    splats: Splats
    capture: Capture
    settings: FitSettings
    asked: dict[str, Any]
    last: Progress
    not_placed: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class FitScores:
    """Scores of a fit.

    Attributes:
        scores: of held-out photos; of fitted ones (see ``train_photos``) where none is held out.
        sheet: those of them that ``views.png`` and ``report.html`` show.
        train: "psnr", "ssim", "views" and "of" of fitted photos.
        refined: mean scores of held-out photos with cameras fitted to them; None where that was
            not asked for.
    """

    scores: Scores
    sheet: list[ScoredView] = field(default_factory=list)
    train: dict[str, Any] = field(default_factory=dict)
    refined: dict[str, float | None] | None = None


def write_scene(out: Path, splats: Splats, capture: Capture) -> None:
    """Write ``scene.ply`` and ``cameras.json``, which need no scores.

    Raises:
        IgsrError: a file cannot be written.
    """
    splats.save(out / "scene.ply")
    write_cameras(out / "cameras.json", capture.train_views)


def fit_report(fit: FinishedFit, scored: FitScores, parts: Parts) -> dict[str, Any]:
    """What ``report.json`` holds.

    Args:
        fit: the fit.
        scored: its scores.
        parts: what each part of the run took.
    """
    held_out = scored.scores.psnr if scored.scores.protocol["split"] == "test" else None
    refined = None if scored.refined is None else scored.refined["psnr"]
    used = parts.plain()
    views, backend = fit.capture.views, fit.asked["backend"]
    return {
        **{metric: scored.scores[metric] for metric in METRICS},
        **({} if scored.refined is None else {"refined": scored.refined}),
        "train": scored.train,
        "limit": limit_of(scored.train["psnr"], held_out, refined).plain(),
        "splats": len(fit.splats),
        "preset": fit.asked["preset"],
        **preset_keywords(fit.settings),
        "removed": fit.last.removed,
        "masked": {name: round(part, 5) for name, part in fit.last.transients.items()},
        "start": fit.last.started[0],
        "start_splats": fit.last.started[1],
        "seconds": round(fit.last.seconds, 3),
        "parts": used,
        "peak_memory_bytes": total(used).peak_memory_bytes,
        "exposures": {
            view.name: view.exposure.plain()
            for view in fit.capture.train_views
            if view.exposure is not None
        },
        "photos": {
            "given": len(views) + len(fit.not_placed),
            "placed": len(views),
            "train": len(fit.capture.train_views),
            "test": len(fit.capture.test_views),
            "not_placed": list(fit.not_placed),
        },
        **_core.backend_info(backend),
        "seed": fit.settings.seed,
        "version": _core.__version__,
        "capture": fit.asked["capture"],
        "settings": fit.asked,
        "protocol": scored.scores.protocol,
        "views": scored.scores.views,
    }


def write_fit_report(
    out: Path, report: dict[str, Any], fit: FinishedFit, scored: FitScores
) -> None:
    """Write ``views.png``, ``report.json`` and ``report.html``.

    Args:
        out: folder to write to.
        report: of ``fit_report``.
        fit: the fit.
        scored: its scores.

    Raises:
        IgsrError: a file cannot be written.
    """
    save_sheet(out / "views.png", contact_sheet(scored.sheet))
    write_json(out / "report.json", report)
    write_fit_page(out / "report.html", report, fit.splats, fit.capture, scored.sheet)
