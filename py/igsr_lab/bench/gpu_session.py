"""All measurements of a GPU within eight minutes, in parts that cannot stop each other."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from igsr.errors import IgsrError
from igsr_lab.bench.fit_rows import STEPS_PER_STATE
from igsr_lab.bench.gpu_report import describe_device, gsplat_steps, write_device_report
from igsr_lab.bench.growth import measure
from igsr_lab.bench.gsplat_rows import NAME, why_not
from igsr_lab.bench.kernel_times import SIZES, SMALL_SIZES, SOFTWARE, kernel_table
from igsr_lab.bench.run import Settings, not_run, rows_or_reason
from igsr_lab.bench.table import describe_machine
from igsr_lab.bench.viewer_rows import SIZES as FRAMES
from igsr_lab.bench.viewer_rows import VIEWER, viewer_rows
from igsr_lab.limited_parts import Entries, Part, run_part

#: Time that a row is repeated.
SECONDS = 1.0
PROTOCOL = (
    f"Kernels: least and median of {STEPS_PER_STATE} steps, each command in its own pass. MB "
    "counts each row once for each load and store; GB/s is by the median."
)


def _device() -> Iterator[Entries]:
    device = describe_device()
    yield {"device": device}
    if device["error"]:
        raise IgsrError(device["error"])


def _kernels(entry: str, sizes: Iterable[tuple[int, int]], seed: int) -> Iterator[Entries]:
    for count, side in sizes:
        yield {entry: [kernel_table(seed, count, side)]}


def _viewer(frame: tuple[int, int], small: bool, seed: int) -> Iterator[Entries]:
    for draw in ("blend", "rasterize"):
        rows = partial(viewer_rows, frame, seed, small, draw)
        yield {"rows": rows_or_reason(f"{VIEWER} by {draw}", "gpu", rows)}


def _steps(sizes: Iterable[tuple[int, int]], seed: int) -> Iterator[Entries]:
    for count, side in sizes:
        rows = partial(_step_rows, seed, count, side)
        yield {"rows": rows_or_reason("W4", "gpu", rows, count)}


def _step_rows(seed: int, count: int, side: int) -> list[dict[str, Any]]:
    return [measure(seed, count, side, "gpu", SECONDS)]


def _gsplat(sizes: Iterable[tuple[int, int]], seed: int) -> Iterator[Entries]:
    reason = why_not()
    if reason:
        yield {"rows": [not_run("W4", NAME, reason)]}
        return
    settings = Settings(("gpu",), seed=seed, seconds=SECONDS)
    for count, side in sizes:
        rows = partial(gsplat_steps, settings, count, side)
        yield {"rows": rows_or_reason("W4", NAME, rows, count)}


#: The first part: the sizes of the rest depend on it.
DEVICE = Part("device", 40.0, _device)


def plan(small: bool, seed: int) -> list[Part]:
    """The parts after the device's; ``small`` has the sizes of software drivers."""
    sizes = SMALL_SIZES if small else SIZES
    timed, checked = (partial(_kernels, name, sizes, seed) for name in ("kernels", "checked"))
    return [
        Part("kernels", 85.0, timed, {"IGSR_GPU_CHECKS": "0"}),
        Part("kernels with checks", 85.0, checked, {"IGSR_GPU_CHECKS": "1"}),
        Part(VIEWER, 80.0, partial(_viewer, FRAMES[-1], small, seed)),
        Part("steps with errors", 110.0, partial(_steps, sizes, seed)),
        Part(NAME, 60.0, partial(_gsplat, sizes, seed)),
    ]


def run_session(path: Path, on_part: Callable[[str], object], seed: int = 0) -> dict[str, Any]:
    """Run all parts, and write the page ``path`` and its JSON file after each.

    Returns the report. Its "parts" have "name", "limit_s", "seconds" and "error", which is None
    for a part that ended well with all of its rows.
    """
    report: dict[str, Any] = {
        "device": {"name": None, "error": "The device did not answer."},
        "machine": describe_machine([], seed),
        **{name: [] for name in ("parts", "kernels", "checked", "rows")},
    }
    report["machine"]["protocol"] += f" {PROTOCOL}"

    def run(part: Part) -> None:
        on_part(part.name)
        began = time.perf_counter()
        found, error = run_part(part)
        for name, entry in (item for entries in found for item in entries.items()):
            report[name] = entry if name == "device" else report[name] + entry
            if name == "rows":
                # A session without gsplat is complete.
                failed = (row["not_run"] for row in entry if "not_run" in row)
                error = error or (None if part.name == NAME else next(failed, None))
        seconds = time.perf_counter() - began
        line = {"name": part.name, "limit_s": part.limit_s, "seconds": seconds, "error": error}
        report["parts"].append(line)
        write_device_report(path, report)

    run(DEVICE)
    for part in plan(report["device"].get("kind") == SOFTWARE, seed):
        run(part)
    return report
