"""Rows of the viewer's frames, drawn as its window does but without one."""

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
from igsr_lab.bench.scenes import ball

VIEWER = "viewer"
#: Sizes of the frames, pixels.
SIZES = ((1280, 720), (1920, 1080))
SH_DEGREE = 3
#: Splats and frames; and those of a software driver, of which a frame takes a second.
SPLATS, FRAMES = 1_000_000, 60
SMALL_SPLATS, SMALL_FRAMES = 20_000, 3
#: Longest time that a call may take, seconds.
TIMEOUT = 600.0


def viewer_rows(size: tuple[int, int], seed: int, small: bool) -> list[dict[str, Any]]:
    """Frames of a ball of splats: the least, the median, and the median of each stage.

    A frame is compared with the rasterizer's picture and not with the reference: ``off_of_255``.

    Args:
        size: of a frame, pixels.
        seed: of the ball.
        small: fewer splats and frames.

    Raises:
        IgsrError: the viewer fails or takes longer than ``TIMEOUT``.
    """
    (width, height), count = size, SMALL_SPLATS if small else SPLATS
    splats = ball(seed, count, width, height, SH_DEGREE).splats
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ball.ply"
        Splats(**{"sh" if name == "colors" else name: a for name, a in splats.items()}).save(file)
        frames = SMALL_FRAMES if small else FRAMES
        words = [str(file), "--time", str(frames), "--size", f"{width}x{height}"]
        text = _told(words)
    stages = {name: float(ms) for name, ms in re.findall(r"^ +([a-z]+) +([0-9.]+)$", text, re.M)}
    off = re.search(r"off the rasterizer's picture by ([0-9]+) of 255", text)
    if not {"whole", "least"} <= stages.keys() or off is None:
        raise IgsrError(f"The viewer printed no times: {text.strip()}")
    return [
        {
            "workload": VIEWER,
            "backend": "gpu",
            "pass": "frame",
            "splats": count,
            "width": width,
            "height": height,
            "ms": stages.pop("least"),
            "ms_median": stages.pop("whole"),
            "stages_ms": stages,
            "off_of_255": int(off[1]),
            "frames": frames,
        }
    ]


def _told(words: list[str]) -> str:
    """What the viewer prints, in a process of its own: a driver that fails may end it."""
    paths = os.pathsep.join(path for path in sys.path if path)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "igsr.rendering.window", *words],
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            env={**os.environ, "PYTHONPATH": paths},
        )
    except subprocess.TimeoutExpired:
        raise IgsrError(f"The viewer took longer than {TIMEOUT:g} s.") from None
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise IgsrError(lines[-1] if lines else f"the viewer ended with status {done.returncode}")
    return done.stdout
