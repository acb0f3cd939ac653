"""The rows of a run as a table for people."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

#: Of a column and whether it is of numbers.
HEADINGS = (
    ("workload", False),
    ("pass", False),
    ("backend", False),
    ("splats", True),
    ("size", True),
    ("ms", True),
    ("of peak", True),
    ("B/splat", True),
    ("max error", True),
    ("mean error", True),
    ("of", False),
    ("left out", True),
)


def rows_table(rows: list[dict[str, Any]]) -> Table:
    """One line per row that ran; ``not_run_lines`` has the others."""
    table = Table(box=None, pad_edge=False)
    for heading, number in HEADINGS:
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        if row["ms"] is None:
            continue
        fraction = row.get("fraction_of_peak")
        memory = row.get("bytes_per_splat")
        table.add_row(
            row["workload"],
            row["pass"] + (f", {row['setting']}" if "setting" in row else ""),
            row["backend"],
            str(row["splats"]),
            f"{row['width']}x{row['height']}",
            milliseconds(row["ms"]),
            "" if fraction is None else f"{100.0 * fraction:.1f} %",
            "" if memory is None else f"{memory:.0f}",
            *_errors(row),
        )
    return table


def _errors(row: dict[str, Any]) -> tuple[str, str, str, str]:
    """Empty for what has no reference, as another library's kernels."""
    if row["max_error"] is None:
        return "", "", "", ""
    return (
        f"{row['max_error']:.1e}",
        f"{row['mean_error']:.1e}",
        row["error_of"],
        f"{row['left_out_pixels']} of {row['compared_pixels']}",
    )


def milliseconds(ms: float) -> str:
    """Three digits, no exponent."""
    return f"{ms:.2f}" if ms < 10 else f"{ms:.1f}" if ms < 100 else f"{ms:.0f}"


def not_run_lines(rows: list[dict[str, Any]]) -> list[str]:
    """One sentence per row that has no figures."""
    lines = []
    for row in rows:
        if row["ms"] is None:
            splats = "" if row["splats"] is None else f" with {row['splats']} splats"
            lines.append(f"{row['workload']}{splats} on {row['backend']} not run: {row['not_run']}")
    return lines


def pairs_table(rows: list[dict[str, Any]]) -> Table:
    """One line per row of two builds that ran."""
    table = Table(box=None, pad_edge=False)
    for heading in ("workload", "pass", "backend"):
        table.add_column(heading, no_wrap=True)
    for heading in ("splats", "size", "ms old", "ms new", "old : new", "from", "to"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading in ("max error old", "new", "mean error old", "new"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        if row["ratio"] is None:
            continue
        table.add_row(
            row["workload"],
            row["pass"],
            row["backend"],
            str(row["splats"]),
            f"{row['width']}x{row['height']}",
            milliseconds(row["ms_old"]),
            milliseconds(row["ms_new"]),
            *(f"{row[name]:.2f}" for name in ("ratio", "ratio_least", "ratio_most")),
            *(
                f"{row[f'{kind}_error_{build}']:.1e}"
                for kind in ("max", "mean")
                for build in ("old", "new")
            ),
        )
    return table


def machine_line(machine: dict[str, Any]) -> str:
    """One line on where and with what the figures were measured."""
    sets = ", ".join(
        f"{name}: {info['instruction_set'] if name != 'gpu' else info['device']}"
        for name, info in machine["backends"].items()
    )
    return (
        f"igsr {machine['igsr']} on {machine['processor']}, {machine['threads']} threads, "
        f"{sets}, peak {machine['peak_gflops']:.0f} GFLOP/s, seed {machine['seed']}, "
        f"{machine['date']}"
    )


def print_report(console: Console, report: dict[str, Any]) -> None:
    """The table, what did not run and why, and how to read it.

    Args:
        console: where to print.
        report: of ``run_benchmark``.
    """
    _print(console, report, rows_table(report["rows"]), not_run_lines(report["rows"]))


def print_pairs(console: Console, report: dict[str, Any]) -> None:
    """As ``print_report``, of ``compare_builds``."""
    rows = report["rows"]
    failed = [
        f"{row['workload']} with {row['splats']} splats on {row['backend']} not compared: "
        f"{row['not_run']}"
        for row in rows
        if row["ratio"] is None
    ]
    _print(console, report, pairs_table(rows), failed)


def _print(console: Console, report: dict[str, Any], table: Table, lines: list[str]) -> None:
    # A terminal breaks long lines by itself; cells that end in an ellipsis say nothing.
    wide = console.options.update(max_width=1000)
    console.width = max(console.width, console.measure(table, options=wide).maximum)
    console.print(table)
    for line in lines:
        console.print(line, markup=False)  # a reason may hold brackets
    console.print(machine_line(report["machine"]), style="dim")
    console.print(report["machine"]["protocol"], style="dim")
