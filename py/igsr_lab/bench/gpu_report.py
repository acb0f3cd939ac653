"""A report about one computer's GPU, to attach to bug reports: a page and a JSON file."""

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
from igsr_lab.bench.growth import GROWN_COUNT, GROWN_SIDE, evenly_chosen, shot_of
from igsr_lab.bench.gsplat_rows import NAME, gsplat_rows, why_not
from igsr_lab.bench.kernel_times import SIZES as SIZES_OF_STEPS
from igsr_lab.bench.kernel_times import SOFTWARE, kernel_tables
from igsr_lab.bench.plots import kernels_plot
from igsr_lab.bench.run import Settings, not_run, rows_or_reason, run_benchmark
from igsr_lab.bench.scenes import garden, upstream
from igsr_lab.bench.stage_rows import pipeline_rows
from igsr_lab.bench.table import milliseconds, not_run_lines
from igsr_lab.bench.viewer_rows import SIZES, VIEWER, viewer_rows
from igsr_lab.report_parts import cell

#: Splats and side of the ball for software adapters.
SMALL_BALL = (10_000, 256)
#: The scene that gsplat renders, too, if no garden is given: W4's, forward and backward.
BALL = "ball"


def describe_device() -> dict[str, Any]:
    """Driver, limits and start times of the device of backend "gpu", or the reason for none."""
    try:
        device = _core.gpu_report()
        opened, compiled, tested = _core.time_gpu_start()
    except RuntimeError as error:
        return {"name": None, "error": str(error)}
    start = {"open_ms": opened, "compile_ms": compiled, "self_test_ms": tested}
    kernels = _core.backend_info("gpu")["instruction_set"]
    return {**device, "kernels": kernels, "start": start, "error": None}


def device_report(
    settings: Settings, on_row: Callable[[str], object] = lambda doing: None
) -> dict[str, Any]:
    """Run the benchmark and describe the device; see ``run_benchmark``.

    W2's scene, or W4's ball without a garden, is timed with gsplat, too, and the viewer's frames
    are timed. Software drivers get smaller scenes, and W4 another name.
    """
    on_row("the device")
    device = describe_device()
    small = device.get("kind") == SOFTWARE and "gpu" in settings.backends
    report = run_benchmark(replace(settings, small=small), on_row)
    count, side = SMALL_BALL if small else (GROWN_COUNT, GROWN_SIDE)
    name = BALL if settings.garden is None else "W2"
    ball = shot_of(settings.seed, count, side)
    scene = ball.scene
    if settings.garden is not None:
        scene = garden(settings.garden, settings.seed)
    if name == BALL:
        for backend in settings.backends:
            on_row(f"{name} on {backend}")
            work = partial(pipeline_rows, name, scene, backend, settings.seed, settings.seconds)
            report["rows"] += rows_or_reason(name, backend, work)
    report["kernels"] = []
    if "gpu" in settings.backends:
        on_row("the kernels of a fit step")
        try:
            report["kernels"] = kernel_tables(settings.seed)
        except RuntimeError as error:  # as the GPU raises
            report["rows"].append(not_run("kernels", "gpu", str(error)))
        for size in SIZES:
            on_row(f"the viewer at {size[0]} x {size[1]}")
            work = partial(viewer_rows, size, settings.seed, small)
            report["rows"] += rows_or_reason(VIEWER, "gpu", work)
    on_row(f"{name} on {NAME}")
    reason = why_not()
    if reason:
        report["rows"].append(not_run(name, NAME, reason))
    else:
        v_image = upstream(settings.seed, scene.width, scene.height)
        photo = ball.photo if name == BALL else None
        work = partial(gsplat_rows, name, scene, v_image, settings.seconds, photo=photo)
        report["rows"] += rows_or_reason(name, NAME, work)
        for count, side in SIZES_OF_STEPS:
            work = partial(gsplat_steps, settings, count, side)
            report["rows"] += rows_or_reason("W4", NAME, work, count)
    return {"device": device, **report}


def gsplat_steps(settings: Settings, count: int, side: int) -> list[dict[str, Any]]:
    """gsplat's rows on a ball of W4."""
    shot = shot_of(settings.seed, count, side)
    v_image = upstream(settings.seed, side, side)
    options: dict[str, Any] = {"photo": shot.photo, "chosen": evenly_chosen}
    return gsplat_rows("W4", shot.scene, v_image, settings.seconds, **options)


def json_beside(path: Path) -> Path:
    """File of a page's figures."""
    if path.suffix.lower() != ".html":
        raise IgsrError(f"{path}: a report is a page; give a name that ends in .html.")
    return path.with_suffix(".json")


def write_device_report(path: Path, report: dict[str, Any]) -> None:
    """Write the page and the JSON file.

    The report may have "tests" of the kernels, and a session's "parts" and tables of kernels with
    checks, "checked".
    """
    write_json(json_beside(path), report)
    variables = {
        "machine": report["machine"],
        "device": report["device"],
        "tests": report.get("tests"),
        "parts": report.get("parts"),
        "kernels": _with_checks(report.get("kernels", []), report.get("checked", [])),
        "rows": [_cells(row) for row in report["rows"] if row["ms"] is not None],
        "not_run": not_run_lines(report["rows"]),
        "json": json_beside(path).name,
        "cell": cell,
    }
    templates = Path(__file__).with_name("templates")
    write_template(path, templates, "gpu.html.jinja", variables)


def _with_checks(
    tables: list[dict[str, Any]], checked: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Tables of kernels with plots, and with the table and medians of the same ball with checks."""
    checked_of = {(table["splats"], table["side"]): table for table in checked}
    result = []
    for table in tables:
        other = checked_of.get((table["splats"], table["side"]))
        medians = {row["name"]: row["median"] for row in other["kernels"]} if other else {}
        kernels = [{**row, "checked": medians.get(row["name"])} for row in table["kernels"]]
        plot = kernels_plot(kernels)
        result.append({**table, "checked": other, "kernels": kernels, "plot": plot})
    return result


def _cells(row: dict[str, Any]) -> dict[str, Any]:
    def error(value: float | None) -> str:
        return "" if value is None else f"{value:.1e}"

    return {
        "workload": row["workload"],
        "pass": row["pass"] + (f", loss by {row['loss']}" if "loss" in row else ""),
        "backend": row["backend"],
        "splats": f"{row['splats']:,}".replace(",", " "),
        "size": f"{row['width']}×{row['height']}",
        "ms": milliseconds(row["ms"]),
        "median": milliseconds(row["ms_median"]) if "ms_median" in row else "",
        "max_error": error(row["max_error"]),
        "mean_error": error(row["mean_error"]),
        "of": row.get("error_of", ""),
    }
