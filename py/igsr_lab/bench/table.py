"""Print rows as tables, with the machine and the protocol."""

from __future__ import annotations

import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from igsr import _core
from igsr_lab.bench.comparison import MIN_FLIP

#: How figures are measured, for the JSON and below tables.
PROTOCOL = (
    "ms is the minimum over the repeats, ms_median their median. Stages are timed in the renderer "
    "on arrays that are converted once; the time of bin is part of rasterize and of "
    "rasterize_backward. GPU times include upload and read-back. Fit steps are timed from outside: "
    "the mean over views of each view's minimum. peak_gflops is the rate of a loop of "
    "multiply-adds on all cores, measured right after the row; a multiply-add counts as two. "
    "fraction_of_peak counts the arithmetic of blended pairs only. Errors are against the f64 "
    "reference on the same f32 inputs: absolute for pictures, over color and alpha; for gradients "
    "divided by the largest gradient of the same parameter, for the worst parameter. A pixel is "
    "left out only within the band of docs/how-it-works/numerics.md, if it differs by more than "
    f"the bound or its transmittance by more than {MIN_FLIP:.1%} (band_pixels, left_out_pixels). "
    "Splats at equal depth up to rounding are in the backend's order. bytes_per_splat is the peak "
    "memory of a CPU fit without the picture's buffers."
)
#: Columns, and whether they are numbers.
HEADINGS = {
    "workload": False,
    "pass": False,
    "backend": False,
    "splats": True,
    "size": True,
    "ms": True,
    "of peak": True,
    "B/splat": True,
    "max error": True,
    "mean error": True,
    "of": False,
    "left out": True,
}
PAIR_HEADINGS = {
    "workload": False,
    "pass": False,
    "backend": False,
    **dict.fromkeys(("splats", "size", "ms old", "ms new", "old : new", "from", "to"), True),
    **dict.fromkeys(("max error old", "max new", "mean error old", "mean new"), True),
}


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
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "protocol": PROTOCOL,
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def machine_line(machine: dict[str, Any]) -> str:
    """The machine in one line."""
    sets = ", ".join(
        f"{name}: {info['instruction_set'] if name != 'gpu' else info['device']}"
        for name, info in machine["backends"].items()
    )
    return (
        f"igsr {machine['igsr']} on {machine['processor']}, {machine['threads']} threads, "
        f"{sets}, peak {machine['peak_gflops']:.0f} GFLOP/s, seed {machine['seed']}, "
        f"{machine['date']}"
    )


def milliseconds(ms: float) -> str:
    """Three digits, no exponent."""
    return f"{ms:.2f}" if ms < 10 else f"{ms:.1f}" if ms < 100 else f"{ms:.0f}"


def not_run_lines(rows: list[dict[str, Any]]) -> list[str]:
    """One sentence per row that did not run."""
    lines = []
    for row in rows:
        if row["ms"] is None:
            splats = "" if row["splats"] is None else f" with {row['splats']} splats"
            lines.append(f"{row['workload']}{splats} on {row['backend']} not run: {row['not_run']}")
    return lines


def print_report(console: Console, report: dict[str, Any]) -> None:
    """Print the rows, the workloads that did not run, and the protocol."""
    rows = [_cells(row) for row in report["rows"] if row["ms"] is not None]
    _print(console, report, HEADINGS, rows, not_run_lines(report["rows"]))


def print_pairs(console: Console, report: dict[str, Any]) -> None:
    """Print the rows of two builds."""
    rows = [_pair_cells(row) for row in report["rows"] if row["ratio"] is not None]
    failed = [
        f"{row['workload']} with {row['splats']} splats on {row['backend']} not compared: "
        f"{row['not_run']}"
        for row in report["rows"]
        if row["ratio"] is None
    ]
    _print(console, report, PAIR_HEADINGS, rows, failed)


def _cells(row: dict[str, Any]) -> list[str]:
    fraction = row.get("fraction_of_peak")
    memory = row.get("bytes_per_splat")
    errors = [""] * 4
    if row["max_error"] is not None:
        left_out = f"{row['left_out_pixels']} of {row['compared_pixels']}"
        largest, mean = (f"{row[name]:.1e}" for name in ("max_error", "mean_error"))
        errors = [largest, mean, row["error_of"], left_out]
    return [
        row["workload"],
        row["pass"] + (f", {row['setting']}" if "setting" in row else ""),
        row["backend"],
        str(row["splats"]),
        f"{row['width']}x{row['height']}",
        milliseconds(row["ms"]),
        "" if fraction is None else f"{100.0 * fraction:.1f} %",
        "" if memory is None else f"{memory:.0f}",
        *errors,
    ]


def _pair_cells(row: dict[str, Any]) -> list[str]:
    return [
        row["workload"],
        row["pass"],
        row["backend"],
        str(row["splats"]),
        f"{row['width']}x{row['height']}",
        *(milliseconds(row[f"ms_{build}"]) for build in ("old", "new")),
        *(f"{row[name]:.2f}" for name in ("ratio", "ratio_least", "ratio_most")),
        *(
            f"{row[f'{kind}_error_{build}']:.1e}"
            for kind in ("max", "mean")
            for build in ("old", "new")
        ),
    ]


def _print(
    console: Console,
    report: dict[str, Any],
    headings: dict[str, bool],
    rows: list[list[str]],
    lines: list[str],
) -> None:
    table = Table(box=None, pad_edge=False)
    for heading, is_number in headings.items():
        table.add_column(heading, justify="right" if is_number else "left", no_wrap=True)
    for cells in rows:
        table.add_row(*cells)
    # Long lines are better than truncated cells.
    wide = console.options.update(max_width=1000)
    console.width = max(console.width, console.measure(table, options=wide).maximum)
    console.print(table)
    for line in lines:
        console.print(line)
    console.print(machine_line(report["machine"]), style="dim")
    console.print(report["machine"]["protocol"], style="dim")
