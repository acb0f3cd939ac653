"""``report.html``: a page without other files that shows a refinement.

This module computes the variables of ``templates/report.html.jinja``. All text is escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr.evaluation.report_page import (
    ADDED,
    PHOTO,
    REJECTED,
    drawn_cameras,
    fitted_cameras,
    jpeg,
    number,
    part_rows,
    photos_and_renders,
    scene_frame,
    write_template,
)
from igsr.evaluation.scores import ScoredView, default_background, over_background
from igsr.refinement.novel_views import NovelView
from igsr.refinement.progress import STAGE_NAMES
from igsr.refinement.results import Refined
from igsr.refinement.selection import MIN_CONFIDENCE, MIN_GAIN, Candidate, Rejected

#: Longest side of photos and of novel views on the page, pixels.
THUMBNAIL_PX, VIEW_PX = 160, 320
#: Digits after the point of each score.
SCORE_DIGITS = {"psnr": 2, "ssim": 4, "flip": 4, "cc_psnr": 2, "cc_ssim": 4}
STAGES = {"cameras": "find cameras", "load": "load photos", **STAGE_NAMES}


def write_page(
    path: Path, refined: Refined, report: dict[str, Any], shown: Sequence[ScoredView] = ()
) -> None:
    """Write the page, whole or not at all.

    Args:
        path: of the page.
        refined: the refinement.
        report: the content of ``report.json``.
        shown: views to show next to their renders.

    Raises:
        IgsrError: the file cannot be written.
    """
    background = default_background(refined.capture)
    name = refined.capture.path.name or "photos"
    tests = [refined.first_test, *(done.test for done in refined.rounds)]
    variables = {
        "name": name,
        "scene": scene_frame(refined.models(), fitted_cameras(refined.capture), background, name),
        "photos": [
            {
                "name": view.name,
                "picture": jpeg(over_background(view.image, background), THUMBNAIL_PX),
            }
            for view in refined.capture.train_views
        ],
        "not_placed": report["photos"]["not_placed"],
        "splats": len(refined.splats),
        "stop": refined.stop,
        "score_rows": _score_rows(refined),
        "test_psnr": [test["psnr"] for test in tests if test],
        "cameras": _cameras(refined),
        "rounds": [
            {
                "selected": [_selected(candidate) for candidate in done.selected],
                "rejected": _rejected(done.rejected),
            }
            for done in refined.rounds
        ],
        "rejected": _rejected(refined.rejected),
        "least_confidence": MIN_CONFIDENCE,
        "least_gain": MIN_GAIN,
        "limit": None if report["limit"] is None else report["limit"]["sentence"],
        "pictures_text": "Held-out photos." if refined.capture.test_views else "Fitted photos.",
        "pictures": photos_and_renders(shown),
        "parts": part_rows(report["parts"], STAGES),
        "settings": report["settings"],
        "peak_memory": report["peak_memory_bytes"],
        "version": report["version"],
        "backend": report["backend"],
        "seed": report["seed"],
    }
    write_template(path, Path(__file__).with_name("templates"), "report.html.jinja", variables)


def _score_rows(refined: Refined) -> list[dict[str, Any]]:
    """Scores of the test views by round; no line without test views."""
    models = [(refined.first_test, refined.first)]
    models += [(done.test, done.splats) for done in refined.rounds]
    rows = []
    for count, (scores, splats) in enumerate(models):
        if scores:
            row: dict[str, Any] = {"label": str(count), "splats": len(splats)}
            for name, digits in SCORE_DIGITS.items():
                row[name] = number(scores.get(name), digits)
            rows.append(row)
    return rows


def _selected(candidate: Candidate) -> dict[str, Any]:
    confidence = np.rint(255.0 * np.clip(candidate.confidence, 0.0, 1.0)).astype(np.uint8)
    return {
        "place": _place(candidate.view),
        "gain": candidate.gain,
        "mean_confidence": candidate.mean_confidence,
        "render": jpeg(candidate.render, VIEW_PX),
        "denoised": jpeg(candidate.denoised, VIEW_PX),
        "confidence": jpeg(confidence, VIEW_PX),
    }


def _rejected(views: Sequence[Rejected]) -> list[dict[str, Any]]:
    """Views that were not added, the largest gain first."""
    return [
        {"place": _place(one.view), "gain": one.gain, "mean_confidence": one.mean_confidence}
        for one in sorted(views, key=lambda one: -one.gain)
    ]


def _place(view: NovelView) -> str:
    where = "between two" if view.between else "outward"
    return f"{view.angle:.0f}° from the nearest known camera, {where}"


def _cameras(refined: Refined) -> list[tuple[int, list[list[float]]]]:
    """Cameras that the page's script draws; photos and added views determine the frame."""
    photos = [view.camera for view in refined.capture.train_views]
    added = [one.view.camera for done in refined.rounds for one in done.selected]
    rejected = [one.view.camera for one in _last_rejected(refined)]
    kinds = [(REJECTED, rejected), (PHOTO, photos), (ADDED, added)]
    return drawn_cameras(kinds, [*photos, *added])


def _last_rejected(refined: Refined) -> Sequence[Rejected]:
    """Views that the last round did not add."""
    if refined.rejected or not refined.rounds:
        return refined.rejected
    return refined.rounds[-1].rejected
