"""What the figures of a run depend on, besides the code."""

from __future__ import annotations

import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

from igsr import _core
from igsr_lab.bench.comparison import FLIP

#: How every figure comes about; goes into the JSON and above the tables.
PROTOCOL = (
    "ms is the least over the repeats, ms_median their median; a stage is timed in the renderer on "
    "arrays converted once, bin within rasterize and rasterize_backward, on the gpu with upload "
    "and read-back; a fit step is timed from outside, as the mean over its views of each one's "
    "least. peak_gflops is a loop of multiply-adds on all cores right after the row, a "
    "multiply-add counting as two; fraction_of_peak counts the arithmetic of blended pairs only. "
    "Errors are against the f64 reference on the same f32 inputs: of a picture absolute, over "
    "colour and alpha; of gradients in parts of the largest of their kind, for the worst kind. "
    "A pixel is left out only within the band of docs/how-it-works/numerics.md, where it differs "
    f"by more than the bound or its transmittance by more than {FLIP:g} of itself (band_pixels, "
    "left_out_pixels); splats at equal depth up to rounding are taken in the backend's order. "
    "bytes_per_splat is the fit's peak memory without that of the picture, told where the fit runs "
    "on the cores."
)


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def describe_machine(backends: list[str], seed: int) -> dict[str, Any]:
    """The machine, the backends on it, and the run's settings."""
    return {
        "processor": _processor(),
        "threads": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "igsr": _core.__version__,
        "backends": {name: _core.backend_info(name) for name in backends},
        "peak_gflops": max(_core.peak_multiply_add(0.02) for _ in range(5)),
        "seed": seed,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "command": " ".join(Path(word).name if i == 0 else word for i, word in enumerate(sys.argv)),
        "protocol": PROTOCOL,
    }
