"""``report.html``: one page, with everything inside, that shows what a refinement did.

The page itself is ``templates/report.html.jinja``; this module says what is put into it. All text
is escaped.
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
    beside,
    drawn_cameras,
    fitted_cameras,
    jpeg,
    number,
    part_rows,
    scene_frame,
    write_template,
)
from igsr.evaluation.scores import ScoredView, default_background, over_background
from igsr.refinement.novel_views import NovelView
from igsr.refinement.progress import STAGE_NAMES
from igsr.refinement.results import HELD_OUT_SIDE_PX, HeldOutView, Refined
from igsr.refinement.selection import MIN_CONFIDENCE, MIN_GAIN, Candidate, Rejected

#: Longest side of photos and of novel views on the page, pixels.
THUMBNAIL_PX, VIEW_PX = 160, 320
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
    validated = [done for done in refined.rounds if done.validation_after]
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
        "validation_psnr": [
            *(done.validation_before["psnr"] for done in validated[:1]),
            *(done.validation_after["psnr"] for done in validated),
        ],
        "test_psnr": [test["psnr"] for test in tests if test],
        "cameras": _cameras(refined),
        "rounds": [
            {
                "accepted": done.accepted,
                "verdict": done.verdict,
                "held_out": [_held_out(view) for view in done.held_out],
                "selected": [_selected(candidate) for candidate in done.selected],
                "rejected": _rejected(done.rejected),
            }
            for done in refined.rounds
        ],
        "rejected": _rejected(refined.rejected),
        "least_confidence": MIN_CONFIDENCE,
        "least_gain": MIN_GAIN,
        "limit": None if report["limit"] is None else report["limit"]["sentence"],
        "beside_text": "Test views." if refined.capture.test_views else "Photos that were fitted.",
        "beside_views": beside(shown),
        "parts": part_rows(report["parts"], STAGES),
        "settings": report["settings"],
        "peak_memory": report["peak_memory_bytes"],
        "version": report["version"],
        "backend": report["backend"],
        "seed": report["seed"],
    }
    write_template(path, Path(__file__).with_name("templates"), "report.html.jinja", variables)


def _score_rows(refined: Refined) -> list[dict[str, Any]]:
    """Lines of the table of scores: held-out photos before and after a round, and test views."""
    rows = []
    if refined.first_test:
        rows.append(_score_row("0, test views", refined.first_test, len(refined.first)))
    for count, done in enumerate(refined.rounds, 1):
        splats = "" if done.splats is None else len(done.splats)
        if done.validation_after:
            before = _score_row(f"{count}, held-out photos before", done.validation_before, "")
            after = _score_row(f"{count}, held-out photos after", done.validation_after, splats)
            after["accepted"] = done.accepted
            after["verdict"] = "accepted" if done.accepted else "not accepted"
            rows += [before, after]
        else:
            rows.append(_score_row(f"{count}, not cross-validated", {}, splats))
        if done.test:
            rows.append(_score_row(f"{count}, test views", done.test, splats))
    return rows


def _score_row(
    label: str, scores: dict[str, float] | dict[str, float | None], splats: int | str
) -> dict[str, Any]:
    row: dict[str, Any] = {"label": label, "splats": splats, "verdict": ""}
    for name, digits in (("psnr", 2), ("ssim", 4), ("flip", 4), ("cc_psnr", 2), ("cc_ssim", 4)):
        row[name] = number(scores.get(name), digits)
    return row


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


def _held_out(view: HeldOutView) -> dict[str, Any]:
    return {
        "name": view.name,
        "psnr_before": view.psnr_before,
        "psnr_after": view.psnr_after,
        "photo": jpeg(view.photo, HELD_OUT_SIDE_PX),
        "before": jpeg(view.before, HELD_OUT_SIDE_PX),
        "after": jpeg(view.after, HELD_OUT_SIDE_PX),
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
    added = [one.view.camera for done in refined.rounds if done.accepted for one in done.selected]
    rejected = [one.view.camera for one in _last_rejected(refined)]
    kinds = [(REJECTED, rejected), (PHOTO, photos), (ADDED, added)]
    return drawn_cameras(kinds, [*photos, *added])


def _last_rejected(refined: Refined) -> Sequence[Rejected]:
    """Views that the last round did not add."""
    if refined.rejected or not refined.rounds:
        return refined.rejected
    return refined.rounds[-1].rejected
