"""What the folder of a fit or a refinement says of itself: how far it is, and its scores.

All files are untrusted: what is not as igsr writes it is left out.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igsr.fitting.followed_run import PROGRESS, RUN, VIEW
from igsr.rendering.scene_surroundings import REPORT, background_beside

#: Seconds without news after which a run may have been interrupted. Bundle adjustment and scoring
#: give none for minutes.
SILENCE = 600.0
#: Most bytes of a file that is read once a second.
MOST_BYTES = 20_000_000
DASH = "–"


@dataclass(frozen=True)
class Scores:
    """A table.

    Attributes:
        head: names of its columns.
        rows: its lines.
    """

    head: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)


def run_progress(folder: Path) -> dict[str, Any] | None:
    """Where a run stands: "text" and "done", in [0, 1]; None where none is under way."""
    path = folder / VIEW / PROGRESS
    progress = _read(path)
    text, done = progress.get("text"), _number(progress.get("done"))
    if not isinstance(text, str) or done is None:
        return None
    try:
        silent = time.time() - path.stat().st_mtime
    except OSError:
        return None
    if silent > SILENCE:
        text += f"; no news for {silent / 60.0:.0f} min, it may have been interrupted"
    return {"text": text[:500], "done": min(1.0, max(0.0, done))}


def run_scores(folder: Path) -> Scores:
    """The scores that a run has written: of a refinement by round, of a fit by split."""
    report = _read(folder / REPORT)
    if isinstance(report.get("rounds"), list):
        head = ["PSNR, dB", "test", "cross-validation", "splats"]
        return Scores(head, [_round_row(*one) for one in enumerate(_rounds_of(report))])
    if run_progress(folder) is not None or "psnr" not in report:
        return Scores()  # a report that is here while a fit runs is an earlier one's
    metrics = ("psnr", "ssim", "flip")
    is_held_out = _within(report, "protocol").get("split") == "test"
    rows = [["held-out photos" if is_held_out else "fitted photos", *_numbers(report, metrics)]]
    if is_held_out:
        rows.append(["fitted photos", *_numbers(_within(report, "train"), metrics)])
    return Scores(["", "PSNR, dB", "SSIM", "FLIP"], rows)


def round_labels(folder: Path) -> dict[int, str]:
    """What the rounds of a refinement are called, by number."""
    rounds = _rounds_of(_read(folder / REPORT))
    labels = {0: "first fit"}
    for number, one in enumerate(rounds):
        psnr = _number(_within(one, "test").get("psnr"))
        score = "" if psnr is None else f", {psnr:.2f} dB"
        labels[number] = ("first fit" if number == 0 else f"round {number}") + score
    return labels


def run_background(folder: Path) -> tuple[float, float, float] | None:
    """The background that a run has recorded, RGB in [0, 1]."""
    color = _read(folder / VIEW / RUN).get("background")
    channels = [_number(channel) for channel in color] if isinstance(color, list) else []
    known = [min(1.0, max(0.0, channel)) for channel in channels if channel is not None]
    if len(channels) == len(known) == 3:
        return known[0], known[1], known[2]
    return background_beside(folder / "scene.ply")


def _round_row(number: int, one: dict[str, Any]) -> list[str]:
    label = "first fit" if number == 0 else f"round {number}"
    if number > 0:
        label += ": accepted" if one.get("accepted") is True else ": not accepted"
    validation = _within(one, "cross_validation")
    before, after = (
        _numbers(_within(validation, when), ("psnr",))[0] for when in ("before", "after")
    )
    validated = DASH if DASH in (before, after) else f"{before} → {after}"
    splats = one.get("splats")
    count = str(splats) if isinstance(splats, int) else DASH
    return [label, *_numbers(_within(one, "test"), ("psnr",)), validated, count]


def _rounds_of(report: dict[str, Any]) -> list[dict[str, Any]]:
    rounds = report.get("rounds")
    if not isinstance(rounds, list):
        return []
    return [one if isinstance(one, dict) else {} for one in rounds]


def _numbers(scores: dict[str, Any], names: tuple[str, ...]) -> list[str]:
    values = [(_number(scores.get(name)), 2 if name == "psnr" else 4) for name in names]
    return [DASH if value is None else f"{value:.{digits}f}" for value, digits in values]


def _within(values: dict[str, Any], key: str) -> dict[str, Any]:
    found = values.get(key)
    return found if isinstance(found, dict) else {}


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # a whole number of hundreds of digits
        return None


def _read(path: Path) -> dict[str, Any]:
    try:
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            return {}
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
