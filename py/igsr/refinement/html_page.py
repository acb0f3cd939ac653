"""``report.html``: one page, with everything inside, that shows what a refinement did."""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr._internal.atomic_write import atomic_write
from igsr.capture import Camera
from igsr.evaluation.scores import default_background, over_background
from igsr.refinement.novel_views import UnseenView
from igsr.refinement.selection import LEAST_TRUST, LEAST_WORTH, Passed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from igsr.refinement.results import Refined, Round
    from igsr.refinement.selection import Candidate

#: Longest side of pictures on the page, pixels.
THUMBNAIL, PICTURE = 160, 320
#: Scores that are drawn, and what to write of them.
SCORES = {"psnr": "PSNR, dB", "ssim": "SSIM", "flip": "FLIP (lower is better)"}

_STYLE = """
:root { color-scheme: light dark; --line: #8886; --good: #2a9d4a; --bad: #d0453b; }
body { font: 15px/1.5 system-ui, sans-serif;
  max-width: 1100px; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { font-weight: 600; } h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); }
table { border-collapse: collapse; } th, td { padding: .25rem .9rem .25rem 0; text-align: right; }
th:first-child, td:first-child { text-align: left; }
tr + tr td { border-top: 1px solid var(--line); }
.row { display: flex; flex-wrap: wrap; gap: .6rem; margin: .6rem 0; }
figure { margin: 0; } figcaption { font-size: 12px; opacity: .75; }
img { display: block; max-width: 100%; border-radius: 3px; }
.views { display: grid; grid-template-columns: repeat(6, 1fr); gap: .5rem; }
@media (max-width: 800px) { .views { grid-template-columns: repeat(3, 1fr); } }
.good { color: var(--good); } .bad { color: var(--bad); }
canvas { border: 1px solid var(--line); border-radius: 4px; touch-action: none; max-width: 100%; }
"""

# Each camera is its centre and the four corners of its picture; dragging turns the scene.
_SCRIPT = """
const cameras = JSON.parse(document.getElementById("cameras").textContent);
const canvas = document.getElementById("scene"), c = canvas.getContext("2d");
let yaw = 0.6, pitch = 0.5, zoom = 1;
function draw() {
  const w = canvas.width, h = canvas.height, s = 0.42 * Math.min(w, h) * zoom;
  const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
  const at = ([x, y, z]) => {
    const a = cy * x + sy * z, b = -sy * x + cy * z;
    return [w / 2 + s * a, h / 2 + s * (cp * y + sp * b)];
  };
  c.clearRect(0, 0, w, h);
  for (const [kind, points] of cameras) {
    c.strokeStyle = ["#3b7dd8", "#e08a1e", "#8888"][kind];
    c.lineWidth = kind === 0 ? 1.6 : 1.1;
    const p = points.map(at);
    c.beginPath();
    for (const i of [1, 2, 3, 4]) {
      c.moveTo(...p[0]); c.lineTo(...p[i]); c.lineTo(...p[i % 4 + 1]);
    }
    c.stroke();
  }
}
let from = null;
canvas.onpointerdown = e => {
  from = [e.clientX, e.clientY];
  canvas.setPointerCapture(e.pointerId);
};
canvas.onpointermove = e => {
  if (!from) return;
  yaw += (e.clientX - from[0]) / 150; pitch += (e.clientY - from[1]) / 150;
  from = [e.clientX, e.clientY]; draw();
};
canvas.onpointerup = () => { from = null; };
canvas.onwheel = e => { zoom *= Math.exp(-e.deltaY / 600); e.preventDefault(); draw(); };
draw();
"""


def write_page(path: Path, refined: Refined, report: dict[str, Any]) -> None:
    """Write the page, whole or not at all; it needs nothing but a browser.

    Raises:
        IgsrError: the file cannot be written.
    """
    parts = [
        _summary(refined),
        _scores(report["rounds"]),
        _cameras(refined),
        _photos(refined, report["not_placed"]),
        *(_round(number, one) for number, one in enumerate(refined.rounds, 1)),
        _not_begun(refined),
        _timings(report),
    ]
    text = (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width"><title>igsr refine</title>'
        f"<style>{_STYLE}</style><body>{''.join(parts)}<script>{_SCRIPT}</script></body></html>\n"
    )
    with atomic_write(path) as temporary:
        # A file may be named by bytes that are no text.
        temporary.write_text(text, encoding="utf-8", errors="xmlcharrefreplace")


def _summary(refined: Refined) -> str:
    accepted = sum(one.accepted for one in refined.rounds)
    stopped = refined.stopped or "it is still running, or was cut off and can be resumed"
    return (
        f"<h1>{html.escape(refined.capture.path.name or 'photos')}</h1><p>"
        f"{len(refined.capture.train_views)} photos, {len(refined.splats)} splats. "
        f"{accepted} of {len(refined.rounds)} rounds accepted. "
        f"<b>Why it stopped:</b> {html.escape(stopped)}.</p>"
    )


def _scores(rows: list[dict[str, Any]]) -> str:
    out = ["<h2>Scores</h2><table><tr><th>round</th>"]
    out += [f"<th>{text}</th>" for text in SCORES.values()] + ["<th>splats</th></tr>"]
    known = False
    for number, row in enumerate(rows):
        lines: list[tuple[str, dict[str, float] | None]] = []
        if number and not row["left_out"]["with"]:
            lines = [(f"{number}, not judged", None)]
        elif number:
            verdict = "accepted" if row["accepted"] else "rolled back"
            style = "good" if row["accepted"] else "bad"
            lines = [
                (f"{number}, left-out photos before", row["left_out"]["before"]),
                (
                    f'{number}, with views: <span class="{style}">{verdict}</span>',
                    row["left_out"]["with"],
                ),
            ]
        if row["test"]:
            known = True
            lines.append((f"{number}, test views (decide nothing)", row["test"]))
        for label, scores in lines:
            cells = "".join(f"<td>{_number(scores, name)}</td>" for name in SCORES)
            out.append(f"<tr><td>{label}</td>{cells}<td>{row['splats'] or ''}</td></tr>")
    out.append("</table>")
    judged = [row["left_out"] for row in rows[1:] if row["left_out"]["with"]]
    if judged:
        left_out = [judged[0]["before"], *(scores["with"] for scores in judged)]
        out.append(_curve([scores["psnr"] for scores in left_out], "photos left out"))
    if known:
        out.append(_curve([row["test"]["psnr"] for row in rows if row["test"]], "test views"))
    return "".join(out)


def _number(scores: dict[str, float] | None, name: str) -> str:
    value = None if scores is None else scores.get(name)
    if value is None:
        return "-"
    return f"{value:.2f}" if name == "psnr" else f"{value:.4f}"


def _curve(values: list[float], of: str) -> str:
    """PSNR of some views over the rounds, as SVG."""
    if len(values) < 2:
        return ""
    low, high = min(values), max(values)
    span = max(high - low, 0.1)
    at = [
        (40 + 300 * k / (len(values) - 1), 120 - 90 * (value - low) / span)
        for k, value in enumerate(values)
    ]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="currentColor"/>'
        f'<text x="{x:.1f}" y="{y - 9:.1f}" font-size="12" text-anchor="middle" '
        f'fill="currentColor">{value:.2f}</text>'
        for (x, y), value in zip(at, values, strict=True)
    )
    return (
        f'<svg width="400" height="150" role="img" aria-label="PSNR of {of}">'
        f'<polyline points="{line}" fill="none" stroke="currentColor"/>{dots}'
        '<text x="40" y="145" font-size="12" fill="currentColor">'
        f"PSNR of {of}, dB, by round</text></svg>"
    )


def _cameras(refined: Refined) -> str:
    known = [view.camera for view in refined.capture.train_views]
    added = [
        one.view.camera for round_ in refined.rounds if round_.accepted for one in round_.chosen
    ]
    centres = np.stack([camera.centre for camera in (*known, *added)])
    middle = centres.mean(axis=0)
    size = max(float(np.linalg.norm(centres - middle, axis=1).max()), 1e-9)
    others = [one.view.camera for one in _last_not_added(refined)]
    drawn = [
        (kind, np.round((_frustum(camera, 0.18 * size) - middle) / size, 4).tolist())
        for kind, cameras in ((2, others), (0, known), (1, added))
        for camera in cameras
    ]
    return (
        "<h2>Cameras</h2><p>Photos blue, added views orange, those that were looked at last and "
        "not added grey; drag to turn, wheel to zoom.</p>"
        '<canvas id="scene" width="720" height="420"></canvas>'
        f'<script type="application/json" id="cameras">{json.dumps(drawn)}</script>'
    )


def _frustum(camera: Camera, depth: float) -> npt.NDArray[np.float64]:
    """The camera's centre and its picture's corners at a depth, [5, 3], world."""
    K, w, h = camera.K, camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    rays = np.concatenate([(corners - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((4, 1))], axis=1)
    world: npt.NDArray[np.float64] = depth * rays @ camera.viewmat[:3, :3] + camera.centre
    return np.concatenate([camera.centre[None], world])


def _photos(refined: Refined, not_placed: list[str]) -> str:
    background = default_background(refined.capture)
    figures = [
        _figure(over_background(view.image, background), html.escape(view.name), THUMBNAIL)
        for view in refined.capture.train_views
    ]
    missing = ""
    if not_placed:
        names = html.escape(", ".join(not_placed))
        missing = f"<p>No camera was found for these, which were left out: {names}.</p>"
    return f'<h2>Photos</h2>{missing}<div class="row">{"".join(figures)}</div>'


def _round(number: int, one: Round) -> str:
    verdict = "accepted" if one.accepted else "rolled back"
    count = len(one.chosen) + len(one.passed)
    out = [
        f"<h2>Round {number}: {verdict}</h2><p>{len(one.chosen)} of {count} unseen views were "
        'chosen: as rendered, cleaned, and where they are trusted.</p><div class="views">'
    ]
    for candidate in one.chosen:
        trust = np.rint(255.0 * np.clip(candidate.trust, 0.0, 1.0)).astype(np.uint8)
        out += [
            _figure(candidate.render, _place(candidate.view), PICTURE),
            _figure(candidate.picture, "cleaned", PICTURE),
            _figure(trust, f"trust {candidate.mean_trust:.2f}", PICTURE),
        ]
    return "".join(out) + "</div>" + _table_of_passed(one.passed)


def _last_not_added(refined: Refined) -> Sequence[Candidate | Passed]:
    """Views that were looked at last; those of a round that was rolled back with the others."""
    if refined.passed or not refined.rounds:
        return refined.passed
    last = refined.rounds[-1]
    return last.passed if last.accepted else [*last.passed, *last.chosen]


def _not_begun(refined: Refined) -> str:
    if not refined.passed:
        return ""
    return "<h2>No further round</h2>" + _table_of_passed(refined.passed)


def _table_of_passed(some: list[Passed]) -> str:
    """Views that were not added, and by which number."""
    if not some:
        return ""
    rows = "".join(
        f"<tr><td>{_place(one.view)}</td>"
        f"<td>{one.mean_trust:.2f}</td><td>{1000.0 * one.worth:.2f}</td></tr>"
        for one in sorted(some, key=lambda one: -one.worth)
    )
    return (
        f"<p>Not added: {len(some)}. A view needs a trust of {LEAST_TRUST:g} and a worth of "
        f"{1000.0 * LEAST_WORTH:g}; the worth is the mean of trust times what cleaning changed, in "
        "thousandths of the colours' range. Of more, those that are worth most are added.</p>"
        f"<table><tr><th>view</th><th>trust</th><th>worth</th></tr>{rows}</table>"
    )


def _place(view: UnseenView) -> str:
    where = "between" if view.between else "beyond"
    return f"{view.angle:.0f}° from the nearest known view, {where} known ones"


def _timings(report: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(part)}</td><td>{seconds:.1f} s</td></tr>"
        for part, seconds in report["seconds"].items()
    )
    memory = report["peak_memory_bytes"]
    peak = "" if memory is None else f"Peak memory {memory / 2**30:.2f} GiB. "
    about = f"igsr {report['version']}, {report['backend']}, seed {report['seed']}"
    return f"<h2>Timings</h2><table>{rows}</table><p>{peak}{html.escape(about)}.</p>"


def _figure(picture: npt.NDArray[np.uint8], caption: str, side: int) -> str:
    image = Image.fromarray(picture)
    image.thumbnail((side, side), Image.Resampling.BOX)
    data = io.BytesIO()
    image.convert("RGB").save(data, format="JPEG", quality=88)
    encoded = base64.b64encode(data.getvalue()).decode()
    return (
        f'<figure><img src="data:image/jpeg;base64,{encoded}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )
