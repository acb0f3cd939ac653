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
            f"{row['max_error']:.1e}",
            f"{row['mean_error']:.1e}",
            row["error_of"],
            f"{row['left_out_pixels']} of {row['compared_pixels']}",
        )
    return table


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
    table = rows_table(report["rows"])
    # A terminal breaks long lines by itself; cells that end in an ellipsis say nothing.
    wide = console.options.update(max_width=1000)
    console.width = max(console.width, console.measure(table, options=wide).maximum)
    console.print(table)
    for line in not_run_lines(report["rows"]):
        console.print(line, markup=False)  # a reason may hold brackets
    console.print(machine_line(report["machine"]), style="dim")
    console.print(report["machine"]["protocol"], style="dim")
