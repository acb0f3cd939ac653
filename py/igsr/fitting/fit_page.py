"""``report.html`` of a fit, from ``templates/fit.html.jinja``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr.capture import Capture
from igsr.evaluation.report_page import (
    ADDED,
    PHOTO,
    PICTURE_PX,
    drawn_cameras,
    fitted_cameras,
    jpeg,
    number,
    part_rows,
    photos_and_renders,
    scene_frame,
    write_template,
)
from igsr.evaluation.scores import ScoredView
from igsr.evaluation.shared_points import SIDE_PX, pair_pictures
from igsr.rendering.scene_page import PageModel
from igsr.splats import Splats

#: Maximum number of photos with transient objects that are shown, and the color of their masks.
MAX_MASKED_PHOTOS = 12
MASK_COLOR = (255, 0, 255)
#: Titles of measured parts.
PARTS = {"cameras": "find cameras", "load": "load photos", "fit": "fit", "score": "score"}


def write_fit_page(
    path: Path,
    report: dict[str, Any],
    splats: Splats,
    capture: Capture,
    shown: Sequence[ScoredView],
) -> None:
    """Write the page, a single file.

    Args:
        path: HTML file to write.
        report: content of ``report.json``.
        splats: the scene.
        capture: photos and cameras.
        shown: views to show next to their renders.

    Raises:
        IgsrError: the file cannot be written.
    """
    train = [view.camera for view in capture.train_views]
    test = [view.camera for view in capture.test_views]
    held_out = report["protocol"]["split"] == "test"
    name, background = _title(report["capture"]), report["protocol"]["background"]
    variables = {
        "name": name,
        "scene": scene_frame([PageModel(name, splats)], fitted_cameras(capture), background, name),
        "photos": report["photos"],
        "splats": report["splats"],
        "seconds": report["seconds"],
        "start": report["start"],
        "start_splats": report["start_splats"],
        "masked": _masked_photos(report["masked"], capture),
        "pairs": _pairs(capture),
        "placed_by": report["photos"]["placed_by"],
        "limit": report["limit"]["sentence"],
        "score_rows": _score_rows(report),
        "pictures_text": "Held-out photos." if held_out else "Fitted photos; none is held out.",
        "pictures": photos_and_renders(shown),
        "cameras": drawn_cameras([(PHOTO, train), (ADDED, test)], train),
        "not_placed": report["photos"]["not_placed"],
        "parts": part_rows(report["parts"], PARTS),
        "peak_memory": report["peak_memory_bytes"],
        "version": report["version"],
        "backend": f"{report['backend']} ({report['instruction_set']})",
        "seed": report["seed"],
        "settings": report["settings"],
    }
    write_template(path, Path(__file__).with_name("templates"), "fit.html.jinja", variables)


def _title(capture: str) -> str:
    path = Path(capture).resolve()
    return (path.parent.name if path.name == "images" else path.name) or "photos"


def _masked_photos(masked: dict[str, float], capture: Capture) -> list[dict[str, str]]:
    """The photos with the most masked pixels, which are tinted."""
    views = {view.name: view for view in capture.train_views}
    names = sorted(masked, key=lambda name: -masked[name])[:MAX_MASKED_PHOTOS]
    rows = []
    for name in (name for name in names if name in views):
        view = views[name]
        picture = view.image[..., :3].copy()
        if view.mask is not None:
            hidden = ~view.mask
            picture[hidden] = (picture[hidden] // 2) + np.array(MASK_COLOR, np.uint8) // 2
        caption = f"{name}, {100.0 * masked[name]:.1f} %"
        rows.append({"picture": jpeg(picture, PICTURE_PX), "caption": caption})
    return rows


def _pairs(capture: Capture) -> list[dict[str, str]]:
    """Pictures of the points that pairs of photos share."""
    if capture.points is None or capture.points.tracks is None:
        return []
    return [
        {"picture": jpeg(picture, 2 * SIDE_PX), "caption": caption}
        for caption, picture in pair_pictures(capture.points.tracks, capture.views)
    ]


def _score_rows(report: dict[str, Any]) -> list[dict[str, str]]:
    rows = []
    if report["protocol"]["split"] == "test":
        rows.append(_row(f"{report['protocol']['views']} held out", report))
        if "refined" in report:
            rows.append(_row("the same with refined cameras", report["refined"]))
        train: dict[str, Any] = report["train"]
    else:
        train = {**report, **report["train"]}
    views, of = report["train"]["views"], report["train"]["of"]
    label = f"{views} fitted" if views == of else f"{views} of {of} fitted"
    return [*rows, _row(label, train)]


def _row(label: str, scores: dict[str, Any]) -> dict[str, str]:
    digits = {"psnr": 2, "ssim": 4, "ms_ssim": 4, "flip": 4, "cc_psnr": 2, "cc_ssim": 4}
    return {
        "label": label,
        **{name: number(scores.get(name), places) for name, places in digits.items()},
    }
