"""Plots of time against error, and of growth."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np

from igsr_lab.bench.growth import GROWN_COUNT, GROWN_SIDE
from igsr_lab.bench.table import machine_line
from igsr_lab.report_parts import new_figure, save_figure

#: Colors that are distinct in print and for the color-blind (Okabe and Ito).
COLORS = {"cpu": "#0072b2", "gpu": "#d55e00", "reference": "#444444"}
MARKERS = "os^Dv*XP<>"
#: Errors of zero are drawn at this error on logarithmic axes.
MIN_ERROR = 1e-16


def kernels_plot(rows: list[dict[str, Any]]) -> str:
    """Draw the times of kernels, also with checks if they are known; PNG in base64."""
    figure = new_figure(8.0, 4.4)
    axis = figure.subplots()
    at = np.arange(len(rows))
    axis.barh(at - 0.2, [row["median"] for row in rows], 0.4, label="median")
    axis.plot([row["least"] for row in rows], at - 0.2, "k|", label="least")
    if any(row["checked"] for row in rows):
        checked = [row["checked"] or 0.0 for row in rows]
        axis.barh(at + 0.2, checked, 0.4, label="median with checks")
    axis.set_yticks(at, [row["name"] for row in rows], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("ms in a step")
    axis.grid(alpha=0.3, axis="x")
    axis.legend(loc="lower right", fontsize=8)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return base64.b64encode(file.getvalue()).decode("ascii")


def plot_speed_vs_error(path: Path, report: dict[str, Any]) -> None:
    """Plot time and largest error of each row of a report, and W4's growth."""
    measured = [row for row in report["rows"] if row["ms"] is not None]
    grown = [row for row in measured if _is_of_growth(row)]
    points = [row for row in measured if not _is_of_growth(row)]
    lines = (1 if points or not grown else 0) + (1 if grown else 0)
    columns = 4 if any("setting" in row for row in points) else 3
    figure = new_figure(4.4 * columns, 4.4 * lines)
    figure.suptitle(machine_line(report["machine"]), fontsize=8, wrap=True)
    axes = figure.subplots(lines, columns, squeeze=False)
    if points or not grown:
        _draw_points(axes[0], points)
    if grown:
        _draw_growth(axes[-1], grown)
    save_figure(figure, path, dpi=110)


def _is_of_growth(row: dict[str, Any]) -> bool:
    on_a_line = row["width"] == GROWN_SIDE or row["splats"] == GROWN_COUNT
    return row["workload"] == "W4" and on_a_line


def _label(row: dict[str, Any]) -> str:
    if "setting" in row:
        return str(row["setting"])
    label = f"{row['workload']} {row['pass']}"
    if row["workload"] in ("W3", "W4"):
        label += f", {round(row['splats'] / 1000)}k splats"
    return label


def _draw_points(axes: Any, rows: list[dict[str, Any]]) -> None:
    """Errors of pictures, of gradients and of settings, and the legend."""
    from matplotlib.lines import Line2D

    labels = list(dict.fromkeys(_label(row) for row in rows))
    marker_of = {label: MARKERS[k % len(MARKERS)] for k, label in enumerate(labels)}
    panels = [
        ("picture", "max_error", "picture", "largest error against the f64 reference"),
        ("gradients", "max_error", "gradients", "largest error, relative to the largest gradient"),
        (
            "picture",
            "setting_mean_error",
            "the setting: lower SH degrees against the highest,\nboth modes against many samples",
            "mean error of the setting",
        ),
    ]
    for axis, (kind, error, title, label) in zip(axes[:-1], panels, strict=False):
        for row in rows:
            if row["error_of"] == kind:
                axis.plot(
                    row["ms"],
                    max(row[error], MIN_ERROR),
                    marker_of[_label(row)],
                    color=COLORS[row["backend"]],
                    markersize=7,
                    alpha=0.7,
                )
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.margins(0.15)
        _plain_numbers(axis.xaxis)
        axis.set_xlabel("time, ms")
        axis.set_ylabel(label)
        axis.set_title(title, fontsize=9)
        axis.grid(alpha=0.3)
    handles = [
        Line2D([], [], color=COLORS[backend], marker="s", linestyle="", label=backend)
        for backend in COLORS
        if any(row["backend"] == backend for row in rows)
    ]
    handles += [
        Line2D([], [], color="#999999", marker=marker, linestyle="", label=label)
        for label, marker in marker_of.items()
    ]
    axes[-1].set_axis_off()
    axes[-1].legend(handles=handles, fontsize=9, loc="upper left", frameon=False)


def _draw_growth(axes: Any, rows: list[dict[str, Any]]) -> None:
    """Time over splats, time over pixels, memory over splats."""
    by_count = [row for row in rows if row["width"] == GROWN_SIDE]
    by_side = [row for row in rows if row["splats"] == GROWN_COUNT]
    with_memory = [row for row in by_count if "bytes_per_splat" in row]
    panels: list[tuple[list[dict[str, Any]], str, str, str, str]] = [
        (by_count, "splats", "ms", f"{GROWN_SIDE}×{GROWN_SIDE} pixels", "ms per fit step"),
        (by_side, "width", "ms", f"{GROWN_COUNT} splats", "ms per fit step"),
        (with_memory, "splats", "bytes_per_splat", "peak memory", "bytes per splat"),
    ]
    for axis, (chosen, across, up, title, label) in zip(axes, panels, strict=True):
        if not chosen:
            axis.set_axis_off()
            continue
        for backend, color in COLORS.items():
            line = sorted((row[across], row[up]) for row in chosen if row["backend"] == backend)
            if line:
                axis.plot(*zip(*line, strict=True), "o-", color=color, label=backend)
        axis.set_xscale("log")
        places = sorted({row[across] for row in chosen})
        axis.set_xticks(places, [_short(place) for place in places])
        axis.minorticks_off()
        axis.set_xlabel("splats" if across == "splats" else "side of the picture, pixels")
        axis.set_ylabel(label)
        axis.set_title(title, fontsize=9)
        axis.grid(alpha=0.3)
        if up == "ms":
            axis.set_yscale("log")
            axis.margins(0.1)
            _plain_numbers(axis.yaxis)
            axis.legend(fontsize=8)
        else:
            axis.axhline(
                chosen[0]["contract_bytes_per_splat"],
                color="#444444",
                linestyle="--",
                linewidth=1,
                label="2 × parameters + gradients + optimizer state",
            )
            axis.set_ylim(bottom=0.0)
            axis.legend(fontsize=8, loc="lower left")


def _plain_numbers(axis: Any) -> None:
    """Label a logarithmic axis with decimal numbers."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def _short(number: int) -> str:
    if number >= 1_000_000:
        return f"{number / 1e6:g}M"
    return f"{number / 1e3:g}k" if number >= 10_000 else str(number)
