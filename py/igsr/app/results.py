"""Results of a finished run for the page: scores in words, pictures and files."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.atomic_write import atomic_write
from igsr._internal.input_files import read_json
from igsr._internal.name_lists import listed
from igsr.capture.image_files import decoded, open_image
from igsr.errors import IgsrError
from igsr.rendering.renders import render
from igsr.rendering.run_folder import CAMERAS, REPORT, SCENE, VIEW, cameras_of, run_background
from igsr.splats import Splats

#: Files that a run writes.
WRITTEN = ("scene.html", "report.html", SCENE, REPORT)
#: Files that are made of them when they are asked for.
EXPORTS = ("scene.spz", "scene.sog", "scene.mp4")
_ORBIT_FRAMES = 120
#: PSNR in dB of held-out photos, and how people would call the renders.
_GRADES = ((32.0, "very sharp"), (28.0, "sharp"), (22.0, "soft"))
MAX_COMPARED = 4

_making = threading.Lock()


def result_file(folder: Path, name: str) -> Path:
    """Return a file of a finished run, which is made if it is an export.

    Args:
        folder: of the run.
        name: one of ``WRITTEN`` and ``EXPORTS``.

    Raises:
        IgsrError: the run does not have this file, or it cannot be made.
    """
    path = folder / name
    if name in EXPORTS and result_file(folder, SCENE):
        with _making:  # the memory of one at a time
            scene = folder / SCENE
            is_made = path.is_file() and path.stat().st_mtime_ns >= scene.stat().st_mtime_ns
            if not is_made:
                _export(folder, name)
    elif name not in WRITTEN:
        raise IgsrError(f"{name} is not a file of a run.")
    if path.is_symlink() or not path.is_file():
        raise IgsrError(f"The run has no {name} yet.")
    return path


def _export(folder: Path, name: str) -> None:
    scene = str(folder / SCENE)
    with atomic_write(folder / name) as temporary:
        words = ["convert", scene, str(temporary)]
        if name.endswith(".mp4"):
            words = ["render", scene, "--orbit", str(_ORBIT_FRAMES), "--out", str(temporary)]
            words += ["--cameras", str(folder / CAMERAS)]
        command = [sys.executable, "-m", "igsr.cli", *words]
        done = subprocess.run(command, capture_output=True, check=False, text=True)
        if done.returncode != 0:
            last = done.stderr.strip().splitlines()[-1:] or ["it ended without a message"]
            raise IgsrError(f"{name} could not be made: {last[0]}")


def in_words(folder: Path, log: Sequence[str]) -> list[str]:
    """Return sentences about a finished run's scene; ``log`` is the output of the run."""
    try:
        report = read_json(folder / REPORT)
        photos, test = report["photos"], report.get("test")
        sentences = [_quality(report, test)]
        missing = photos["not_placed"]
        if missing:
            count = f"{len(missing)} of {photos['given']} photos are not placed: {listed(missing)}."
            # The run printed why.
            sentences += [line for line in log if any(name in line for name in missing)] or [count]
        limit = report.get("limit") or {}
        if limit.get("sentence"):
            # Without the options of commands.
            sentences.append(re.sub(r" \(--[^)]*\)", "", limit["sentence"]))
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return ["The report cannot be read."]
    return sentences


def _quality(report: dict[str, Any], test: dict[str, float] | None) -> str:
    scores, kind = (test, "held-out") if test else (report["train"], "fitted")
    psnr, ssim = scores["psnr"], scores["ssim"]
    grade = next((word for least, word in _GRADES if psnr >= least), "blurred")
    return f"Renders of {kind} photos are {grade}: PSNR {psnr:.1f} dB, SSIM {ssim:.3f}."


def comparisons(folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return photos and the renders of their views, uint8 [H, W, 3] each.

    They are held out, if the run held out photos; at most ``MAX_COMPARED``.
    """
    view = folder / VIEW
    try:
        cameras = cameras_of(view / CAMERAS)
        splats = Splats.load(folder / SCENE)
        background = run_background(folder) or (0.0, 0.0, 0.0)
        chosen = np.unique(np.linspace(0, len(cameras) - 1, MAX_COMPARED).round().astype(int))
        pairs = []
        for one in (cameras[k] for k in chosen):
            with open_image(view / one.name) as photo:
                pixels, _ = decoded(photo, view / one.name, (one.camera.width, one.camera.height))
            pairs.append((pixels, render(splats, one.camera, background, "cpu").to_uint8()))
    except IgsrError:
        return []
    return pairs
