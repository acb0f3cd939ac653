"""Read the folder of a fit or a refinement: cameras, background, progress and scores.

The files are untrusted; malformed content is ignored.
"""

from __future__ import annotations

import math
import time
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

from igsr._internal.input_files import read_json
from igsr.capture.load import describe_capture
from igsr.capture.read_transforms import MAX_VALUES, read_cameras
from igsr.errors import IgsrError
from igsr.rendering.scene_page import PageCamera

Color = tuple[float, float, float]

SCENE = "scene.ply"
CAMERAS = "cameras.json"
REPORT = "report.json"
#: The folder that a run writes for ``igsr view --web``, and its files.
VIEW = "view"
RUN = "run.json"
PROGRESS = "progress.json"
#: Age of the progress after which a run may have been interrupted. Bundle adjustment and scoring
#: write no progress for minutes.
MAX_SILENCE_S = 600.0
MISSING = "–"
#: Values of a report; a few are kept parsed, which takes up to 100 bytes per value.
MAX_REPORT_VALUES = 1 << 17


def cameras_of(capture: Path, most: int = MAX_VALUES) -> list[PageCamera]:
    """Read the cameras of a ``cameras.json``, its folder, or any capture, without photos.

    A ``cameras.json`` of more than ``most`` values is refused.
    """
    for path in (capture, capture / CAMERAS):
        if path.name == CAMERAS and path.is_file():
            return [PageCamera(name, camera) for name, camera in read_cameras(path, most)]
    return [PageCamera(shot.name, shot.camera) for shot in describe_capture(capture).shots]


def cameras_beside(scene: Path) -> list[PageCamera]:
    """Read the ``cameras.json`` of the run that wrote ``scene``; empty without one.

    A file that cannot be read gives a ``UserWarning``.
    """
    for folder in _run_folders(scene):
        if (folder / CAMERAS).is_file():
            try:
                return cameras_of(folder / CAMERAS)
            except IgsrError as error:
                warnings.warn(f"{error}; the page has no cameras", stacklevel=2)
                return []
    return []


def background_beside(scene: Path) -> Color | None:
    """Read the background, RGB in [0, 1], from the report of the run that wrote ``scene``."""
    for folder in _run_folders(scene):
        report = _read(folder / REPORT)
        # In a refinement's report, only the last test scores have a protocol.
        protocol = _member(report, "protocol") or _member(_member(report, "test"), "protocol")
        color = _color(protocol.get("background"))
        if color is not None:
            return color
    return None


def run_background(folder: Path) -> Color | None:
    """Read the background, RGB in [0, 1], of a run that may still be going on."""
    color = _color(_read(folder / VIEW / RUN).get("background"))
    return background_beside(folder / SCENE) if color is None else color


def run_progress(folder: Path) -> dict[str, Any] | None:
    """Read the progress of a run: "text", and "done" in [0, 1]; None if no run is going on."""
    path = folder / VIEW / PROGRESS
    progress = _read(path)
    text, done = progress.get("text"), _number(progress.get("done"))
    if not isinstance(text, str) or done is None:
        return None
    try:
        age = time.time() - path.stat().st_mtime
    except OSError:
        return None
    if age > MAX_SILENCE_S:
        text += f"; no news for {age / 60.0:.0f} min, it may have been interrupted"
    return {"text": text[:500], "done": min(1.0, max(0.0, done))}


def run_scores(folder: Path) -> dict[str, Any]:
    """Read the scores of a run as a table, "head" and "rows": by round, or by split."""
    report = _read(folder / REPORT)
    if isinstance(report.get("rounds"), list):
        rows = [_round_row(number, row) for number, row in enumerate(_rounds(report))]
        return {"head": ["", "PSNR, dB", "splats"], "rows": rows}
    if run_progress(folder) is not None or "psnr" not in report:
        return {"head": [], "rows": []}  # while a fit runs, the report is an earlier run's
    metrics = ("psnr", "ssim", "flip")
    is_held_out = _member(report, "protocol").get("split") == "test"
    rows = [["held-out photos" if is_held_out else "fitted photos", *_texts(report, metrics)]]
    if is_held_out:
        rows.append(["fitted photos", *_texts(_member(report, "train"), metrics)])
    return {"head": ["", "PSNR, dB", "SSIM", "FLIP"], "rows": rows}


def round_labels(folder: Path) -> dict[int, str]:
    """Return labels for the rounds of a refinement, with their test PSNR."""
    labels = {0: "first fit"}
    for number, row in enumerate(_rounds(_read(folder / REPORT))):
        psnr = _number(_member(row, "test").get("psnr"))
        labels[number] = _label(number) + ("" if psnr is None else f", {psnr:.2f} dB")
    return labels


def _run_folders(scene: Path) -> list[Path]:
    """The scene's folder, and the refinement's if it is in ``rounds/N`` or ``checkpoints``."""
    folder = scene.parent.resolve()
    if folder.parent.name == "rounds":
        return [scene.parent, folder.parent.parent]
    return [scene.parent, folder.parent] if folder.name == "checkpoints" else [scene.parent]


def _label(number: int) -> str:
    return "first fit" if number == 0 else f"round {number}"


def _round_row(number: int, row: dict[str, Any]) -> list[str]:
    splats = row.get("splats")
    count = str(splats) if isinstance(splats, int) else MISSING
    return [_label(number), *_texts(_member(row, "test"), ("psnr",)), count]


def _rounds(report: dict[str, Any]) -> list[dict[str, Any]]:
    rounds = report.get("rounds")
    if not isinstance(rounds, list):
        return []
    return [row if isinstance(row, dict) else {} for row in rounds]


def _texts(scores: dict[str, Any], names: tuple[str, ...]) -> list[str]:
    values = [(_number(scores.get(name)), 2 if name == "psnr" else 4) for name in names]
    return [MISSING if value is None else f"{value:.{digits}f}" for value, digits in values]


def _member(values: dict[str, Any], key: str) -> dict[str, Any]:
    member = values.get(key)
    return member if isinstance(member, dict) else {}


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # an integer of hundreds of digits
        return None


def _color(value: object) -> Color | None:
    channels = [_number(channel) for channel in value] if isinstance(value, list) else []
    in_range = [channel for channel in channels if channel is not None and 0.0 <= channel <= 1.0]
    if len(channels) != 3 or len(in_range) != 3:
        return None
    return in_range[0], in_range[1], in_range[2]


def _read(path: Path) -> dict[str, Any]:
    """The content of a file, which each page asks for once a second."""
    try:
        status = path.stat()
    except OSError:
        return {}
    return _parsed(path, status.st_ino, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=8)
def _parsed(path: Path, *version: int) -> dict[str, Any]:
    try:
        content = read_json(path, most=MAX_REPORT_VALUES)
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
