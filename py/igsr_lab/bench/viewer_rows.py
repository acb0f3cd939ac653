"""Rows of the viewer's frames, drawn without a window."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from igsr.errors import IgsrError
from igsr.splats import Splats
from igsr_lab.bench.comparison import size_row
from igsr_lab.bench.scenes import ball

VIEWER = "viewer"
#: Sizes of the frames, pixels.
SIZES = ((1280, 720), (1920, 1080))
SH_DEGREE = 3
#: Splats and frames on a GPU.
SPLATS = 1_000_000
FRAMES = 60
#: Splats and frames of a software driver, which takes a second per frame.
SMALL_SPLATS = 20_000
SMALL_FRAMES = 3
#: Time limit of a call.
TIMEOUT_SECONDS = 600.0


def viewer_rows(
    size: tuple[int, int], seed: int, small: bool, draw: str = "auto"
) -> list[dict[str, Any]]:
    """Minimum and median time of a frame of a ball of splats, and the median of each stage.

    A frame is compared with the rasterizer's picture, not with the reference: ``off_of_255``.
    """
    (width, height), count = size, SMALL_SPLATS if small else SPLATS
    splats = ball(seed, count, width, height, SH_DEGREE).splats
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ball.ply"
        Splats(**{"sh" if name == "colors" else name: a for name, a in splats.items()}).save(file)
        frames = SMALL_FRAMES if small else FRAMES
        words = [str(file), "--time", str(frames), "--size", f"{width}x{height}", "--draw", draw]
        text = _output(words)
    stages = {name: float(ms) for name, ms in re.findall(r"^ +([a-z]+) +([0-9.]+)$", text, re.M)}
    off = re.search(r"off the rasterizer's picture by ([0-9]+) of 255", text)
    if not {"whole", "least"} <= stages.keys() or off is None:
        raise IgsrError(f"The viewer printed no times: {text.strip()}")
    return [
        {
            **size_row(VIEWER, "gpu", count, width, height),
            "pass": "frame" if draw == "auto" else f"frame by {draw}",
            "ms": stages.pop("least"),
            "ms_median": stages.pop("whole"),
            "stages_ms": stages,
            "off_of_255": int(off[1]),
            "frames": frames,
        }
    ]


def _output(words: list[str]) -> str:
    """Run the viewer in its own process, which a failing driver may end; return its output."""
    paths = os.pathsep.join(path for path in sys.path if path)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "igsr.rendering.window", *words],
            capture_output=True,
            text=True,
            timeout=TIMEOUT_SECONDS,
            env={**os.environ, "PYTHONPATH": paths},
        )
    except subprocess.TimeoutExpired:
        raise IgsrError(f"The viewer took longer than {TIMEOUT_SECONDS:g} s.") from None
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise IgsrError(lines[-1] if lines else f"the viewer ended with status {done.returncode}")
    return done.stdout
