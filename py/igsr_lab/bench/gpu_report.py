"""A report of one computer's GPU that a person can attach to a message: one page, one JSON file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.json_file import write_json
from igsr.errors import IgsrError
from igsr.evaluation.report_page import write_template
from igsr_lab.bench.growth import GROWN_COUNT, GROWN_SIDE, shot_of
from igsr_lab.bench.gsplat_rows import NAME, gsplat_rows, why_not
from igsr_lab.bench.run import COLUMNS, Settings, not_run, run_benchmark
from igsr_lab.bench.scenes import garden, upstream
from igsr_lab.bench.stage_rows import pipeline_rows
from igsr_lab.bench.table import milliseconds, not_run_lines
from igsr_lab.bench.viewer_rows import SIZES, VIEWER, viewer_rows

#: What wgpu calls an adapter that is a program.
SOFTWARE = "Cpu"
#: Splats and side of that scene where such an adapter draws it.
SMALL_BALL = (10_000, 256)
#: The scene that is drawn beside gsplat's, where no garden is given: W4's, forward and backward.
BALL = "ball"


def describe_device() -> dict[str, Any]:
    """Driver, limits and start of the device of the backend "gpu", or why there is none."""
    try:
        device = _core.gpu_report()
        opened, compiled, tested = _core.time_gpu_start()
    except RuntimeError as error:
        return {"name": None, "error": str(error)}
    start = {"open_ms": opened, "compile_ms": compiled, "self_test_ms": tested}
    return {**device, "start": start, "error": None}


def device_report(
    settings: Settings, on_row: Callable[[str], object] = lambda doing: None
) -> dict[str, Any]:
    """The benchmark with what a reader needs to know of the device; see ``run_benchmark``.

    W2's scene, or W4's ball where no garden is given, is timed by gsplat too. The viewer's frames
    are timed. Where a software driver stands in for a GPU, scenes are smaller, and W4 says so by
    its name.

    Args:
        settings: what to run.
        on_row: told what is about to run.

    Raises:
        IgsrError: a file that was given cannot be used.
    """
    on_row("the device")
    device = describe_device()
    small = device.get("kind") == SOFTWARE and "gpu" in settings.backends
    report = run_benchmark(replace(settings, small=small), on_row)
    count, side = SMALL_BALL if small else (GROWN_COUNT, GROWN_SIDE)
    name = BALL if settings.garden is None else "W2"
    scene = (
        shot_of(settings.seed, count, side).scene
        if settings.garden is None
        else garden(settings.garden, settings.seed)
    )
    if name == BALL:
        for backend in settings.backends:
            on_row(f"{name} on {backend}")
            work = partial(pipeline_rows, name, scene, backend, settings.seed, settings.seconds)
            report["rows"] += _rows(name, backend, work)
    if "gpu" in settings.backends:
        for size in SIZES:
            on_row(f"the viewer at {size[0]} x {size[1]}")
            work = partial(viewer_rows, size, settings.seed, small)
            report["rows"] += _rows(VIEWER, "gpu", work)
    on_row(f"{name} on {NAME}")
    reason = why_not()
    v_image = upstream(settings.seed, scene.width, scene.height)
    report["rows"] += (
        [{**COLUMNS, **not_run(name, NAME, reason)}]
        if reason
        else _rows(name, NAME, lambda: gsplat_rows(name, scene, v_image, settings.seconds))
    )
    return {"device": device, **report}


def _rows(name: str, backend: str, work: Callable[[], list[dict[str, Any]]]) -> Any:
    try:
        rows = work()
    except (IgsrError, RuntimeError) as error:
        rows = [not_run(name, backend, str(error))]
    return [{**COLUMNS, **row} for row in rows]


def json_beside(path: Path) -> Path:
    """Where the figures of a page go.

    Args:
        path: of the page.

    Raises:
        IgsrError: the page's name does not end in .html.
    """
    if path.suffix.lower() != ".html":
        raise IgsrError(f"{path}: a report is a page; give it a name that ends in .html.")
    return path.with_suffix(".json")


def write_device_report(path: Path, report: dict[str, Any]) -> None:
    """Write the page, and the figures as JSON beside it, each whole or not at all.

    Args:
        path: of the page.
        report: of ``device_report``, with "tests" where the kernels' tests were run.

    Raises:
        IgsrError: a file cannot be written.
    """
    write_json(json_beside(path), report)
    variables = {
        "machine": report["machine"],
        "device": report["device"],
        "tests": report.get("tests"),
        "rows": [_cells(row) for row in report["rows"] if row["ms"] is not None],
        "not_run": not_run_lines(report["rows"]),
        "json": json_beside(path).name,
    }
    templates = Path(__file__).with_name("templates")
    write_template(path, templates, "gpu.html.jinja", variables)


def _cells(row: dict[str, Any]) -> dict[str, Any]:
    def error(value: float | None) -> str:
        return "" if value is None else f"{value:.1e}"

    return {
        "workload": row["workload"],
        "pass": row["pass"],
        "backend": row["backend"],
        "splats": f"{row['splats']:,}".replace(",", " "),
        "size": f"{row['width']}×{row['height']}",
        "ms": milliseconds(row["ms"]),
        "median": milliseconds(row["ms_median"]) if "ms_median" in row else "",
        "max_error": error(row["max_error"]),
        "mean_error": error(row["mean_error"]),
        "of": row.get("error_of", ""),
    }
