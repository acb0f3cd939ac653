"""Times of a fit step's kernels on the GPU, by its timestamps."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from igsr import _core
from igsr_lab.bench.fit_rows import STEPS_PER_STATE, Shot, fitter
from igsr_lab.bench.growth import shot_of
from igsr_lab.bench.kernel_bytes import step_bytes
from igsr_lab.report_parts import cell

#: wgpu's kind of software adapters.
SOFTWARE = "Cpu"
#: Splats and side of W4's ball, for GPUs and for software adapters.
SIZES = ((20_000, 400), (100_000, 512), (1_000_000, 512), (100_000, 2048))
SMALL_SIZES = ((10_000, 256),)
#: Steps that are not measured: buffers of pairs grow in them.
WARM_UP = 4


def step_kernels(shot: Shot, repeats: int = STEPS_PER_STATE) -> dict[str, Any]:
    """Measure the kernels of a fit step.

    Args:
        shot: scene and photo.
        repeats: number of measured steps.

    Returns:
        "kernels": for each kernel its "name", "calls" in a step, and the "least" and "median"
        milliseconds of all calls in a step, the slowest kernel first; "mb" is the traffic of
        ``step_bytes`` and "gb_per_s" that by the median, None if it is not known. "device_ms" is
        the median
        of whole steps on the device, "ms" the mean time of steps that are not measured.

    Raises:
        RuntimeError: no adapter is found, or it has no timestamps.
    """
    running = fitter(shot, "gpu")
    running.step(WARM_UP)
    before = time.perf_counter()
    running.step(repeats)
    ms = 1e3 * (time.perf_counter() - before) / repeats
    steps = running.measured_steps(repeats)
    times: dict[str, list[float]] = defaultdict(list)
    for step in steps:
        sums: dict[str, float] = defaultdict(float)
        for name, spent in step:
            sums[name] += spent
        for name, spent in sums.items():
            times[name].append(spent)
    calls = [name for name, _ in steps[0]]
    moved = step_bytes(shot.scene)
    kernels: list[dict[str, Any]] = []
    for name, all_ms in times.items():
        median = float(np.median(all_ms))
        mb = moved[name] / 1e6 if name in moved else None
        speed = None if mb is None or median == 0.0 else mb / median
        row = {"name": name, "calls": calls.count(name), "least": min(all_ms), "median": median}
        kernels.append({**row, "mb": mb, "gb_per_s": speed})
    return {
        "ms": ms,
        "device_ms": float(np.median([sum(spent for _, spent in step) for step in steps])),
        "kernels": sorted(kernels, key=lambda row: -row["median"]),
    }


def kernel_tables(seed: int) -> list[dict[str, Any]]:
    """Measure the kernels on W4's balls, small ones on software adapters; see ``step_kernels``."""
    small = _core.gpu_report()["kind"] == SOFTWARE
    return [kernel_table(seed, *size) for size in (SMALL_SIZES if small else SIZES)]


def kernel_table(seed: int, count: int, side: int) -> dict[str, Any]:
    """Measure the kernels on one of W4's balls; see ``step_kernels``."""
    return {"splats": count, "side": side, **step_kernels(shot_of(seed, count, side))}


def print_kernels(console: Console, tables: list[dict[str, Any]]) -> None:
    """Print a table for each ball."""
    for found in tables:
        side = found["side"]
        table = Table(
            title=f"{found['splats']} splats, {side}x{side}: {found['ms']:.2f} ms a step, "
            f"{found['device_ms']:.2f} ms on the device with a pass for each command",
            title_justify="left",
            box=None,
        )
        for heading in ("kernel", "calls", "ms, least", "median", "%", "MB", "GB/s"):
            table.add_column(heading, justify="left" if heading == "kernel" else "right")
        for row in found["kernels"]:
            share = f"{100.0 * row['median'] / found['device_ms']:.1f}"
            times = (f"{row['least']:.3f}", f"{row['median']:.3f}")
            moved = (cell(row["mb"], ".1f"), cell(row["gb_per_s"], ".1f"))
            table.add_row(row["name"], str(row["calls"]), *times, share, *moved)
        console.print(table)
