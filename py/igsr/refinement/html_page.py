"""``report.html``: one page, with everything inside, that shows what a refinement did.

The page itself is ``templates/report.html.jinja``; this module says what is put into it. All text
is escaped.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr._internal.atomic_write import atomic_write
from igsr.capture import Camera
from igsr.evaluation.scores import default_background, over_background
from igsr.refinement.novel_views import NovelView
from igsr.refinement.results import Refined, Round
from igsr.refinement.selection import LEAST_CONFIDENCE, LEAST_GAIN, Candidate, Rejected

#: Longest side of pictures on the page, pixels.
THUMBNAIL, PICTURE = 160, 320
#: How the page's script draws cameras, by the first number of each.
PHOTO, ADDED, REJECTED = 0, 1, 2
#: Stages as the page calls them.
STAGES = {
    "fit": "fit the photos",
    "novel_views": "render and denoise novel views",
    "cross_validate": "cross-validate",
    "refit": "refit with novel views",
    "test": "score the test views",
}
_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def write_page(path: Path, refined: Refined, report: dict[str, Any]) -> None:
    """Write the page, whole or not at all; it needs nothing but a browser.

    Args:
        path: where to.
        refined: what the page shows.
        report: of ``report.json``.

    Raises:
        IgsrError: the file cannot be written.
    """
    background = default_background(refined.capture)
    validated = [done for done in refined.rounds if done.validation_after]
    tests = [refined.first_test, *(done.test for done in refined.rounds)]
    text = _TEMPLATES.get_template("report.html.jinja").render(
        name=refined.capture.path.name or "photos",
        photos=[
            {
                "name": view.name,
                "picture": _jpeg(over_background(view.image, background), THUMBNAIL),
            }
            for view in refined.capture.train_views
        ],
        not_registered=report["not_registered"],
        splats=len(refined.splats),
        stop=refined.stop,
        score_rows=_score_rows(refined),
        validation_psnr=[
            *(done.validation_before["psnr"] for done in validated[:1]),
            *(done.validation_after["psnr"] for done in validated),
        ],
        test_psnr=[test["psnr"] for test in tests if test],
        cameras=_cameras(refined),
        rounds=[
            {
                "accepted": done.accepted,
                "selected": [_selected(candidate) for candidate in done.selected],
                "rejected": _rejected(done.rejected),
            }
            for done in refined.rounds
        ],
        rejected=_rejected(refined.rejected),
        least_confidence=LEAST_CONFIDENCE,
        least_gain=LEAST_GAIN,
        seconds={STAGES[stage]: seconds for stage, seconds in report["seconds"].items()},
        peak_memory=report["peak_memory_bytes"],
        version=report["version"],
        backend=report["backend"],
        seed=report["seed"],
    )
    with atomic_write(path) as temporary:
        # A file may be named by bytes that are no text.
        temporary.write_text(text, encoding="utf-8", errors="xmlcharrefreplace")


def _score_rows(refined: Refined) -> list[dict[str, Any]]:
    """Lines of the table of scores: held-out photos before and after a round, and test views."""
    rows = []
    if refined.first_test:
        rows.append(_score_row("0, test views", refined.first_test, len(refined.first)))
    for number, done in enumerate(refined.rounds, 1):
        splats = "" if done.splats is None else len(done.splats)
        if done.validation_after:
            before = _score_row(f"{number}, held-out photos before", done.validation_before, "")
            after = _score_row(f"{number}, held-out photos after", done.validation_after, splats)
            after["accepted"] = done.accepted
            after["verdict"] = "accepted" if done.accepted else "rolled back"
            rows += [before, after]
        else:
            rows.append(_score_row(f"{number}, not cross-validated", {}, splats))
        if done.test:
            rows.append(_score_row(f"{number}, test views", done.test, splats))
    return rows


def _score_row(
    label: str, scores: dict[str, float] | dict[str, float | None], splats: int | str
) -> dict[str, Any]:
    row: dict[str, Any] = {"label": label, "splats": splats, "verdict": ""}
    for name, digits in (("psnr", 2), ("ssim", 4), ("flip", 4)):
        value = scores.get(name)
        row[name] = "-" if value is None else f"{value:.{digits}f}"
    return row


def _selected(candidate: Candidate) -> dict[str, Any]:
    confidence = np.rint(255.0 * np.clip(candidate.confidence, 0.0, 1.0)).astype(np.uint8)
    return {
        "place": _place(candidate.view),
        "gain": candidate.gain,
        "mean_confidence": candidate.mean_confidence,
        "render": _jpeg(candidate.render, PICTURE),
        "denoised": _jpeg(candidate.denoised, PICTURE),
        "confidence": _jpeg(confidence, PICTURE),
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
    """What the page's script draws: a kind, and a camera's centre and corners, [5, 3].

    Coordinates are relative to the middle of the known cameras' centres, of which the farthest is
    at distance 1.
    """
    photos = [view.camera for view in refined.capture.train_views]
    added = [one.view.camera for done in refined.rounds if done.accepted for one in done.selected]
    rejected = [one.view.camera for one in _last_rejected(refined)]
    centres = np.stack([camera.centre for camera in (*photos, *added)])
    middle = centres.mean(axis=0)
    size = max(float(np.linalg.norm(centres - middle, axis=1).max()), 1e-9)
    return [
        (kind, np.round((_frustum(camera, 0.18 * size) - middle) / size, 4).tolist())
        for kind, cameras in ((REJECTED, rejected), (PHOTO, photos), (ADDED, added))
        for camera in cameras
    ]


def _last_rejected(refined: Refined) -> Sequence[Candidate | Rejected]:
    """Views that the last round did not add; of one that was rolled back all."""
    if refined.rejected or not refined.rounds:
        return refined.rejected
    last: Round = refined.rounds[-1]
    return last.rejected if last.accepted else [*last.rejected, *last.selected]


def _frustum(camera: Camera, depth: float) -> npt.NDArray[np.float64]:
    """The camera's centre and its picture's corners at a depth, [5, 3], world."""
    K, w, h = camera.K, camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    rays = np.concatenate([(corners - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((4, 1))], axis=1)
    world: npt.NDArray[np.float64] = depth * rays @ camera.viewmat[:3, :3] + camera.centre
    return np.concatenate([camera.centre[None], world])


def _jpeg(picture: npt.NDArray[np.uint8], side: int) -> str:
    """A picture, at most ``side`` pixels wide and high, as JPEG in base64."""
    image = Image.fromarray(picture)
    image.thumbnail((side, side), Image.Resampling.BOX)
    data = io.BytesIO()
    image.convert("RGB").save(data, format="JPEG", quality=88)
    return base64.b64encode(data.getvalue()).decode()
