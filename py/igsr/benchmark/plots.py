"""Time against error, and growth, as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..atomic_write import atomic_write
from .table import machine_line

#: Colours that stay apart in print and for the colour-blind (Okabe and Ito).
COLORS = {"cpu": "#0072b2", "gpu": "#d55e00", "reference": "#444444"}
MARKERS = {"picture": "o", "gradients": "^"}
#: What is exactly right has no place on a logarithmic axis; it is drawn at this error.
LEAST_ERROR = 1e-10


def plot_speed_vs_error(path: Path, report: dict[str, Any]) -> None:
    """Write a PNG of (time, largest error) of each row, and of W4's growth where there is any.

    Raises:
        IgsrError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    measured = [row for row in report["rows"] if row["ms"] is not None]
    grown = [row for row in measured if "bytes_per_splat" in row]
    points = [row for row in measured if "bytes_per_splat" not in row]
    panels = (1 if points or not grown else 0) + (3 if grown else 0)
    figure = Figure(figsize=(6.4 * min(panels, 2), 4.8 * ((panels + 1) // 2)), layout="constrained")
    figure.suptitle(machine_line(report["machine"]), fontsize=9)
    axes = list(figure.subplots((panels + 1) // 2, min(panels, 2), squeeze=False).flat)
    if points or not grown:
        _draw_points(axes.pop(0), points)
    if grown:
        _draw_growth(axes, grown)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def _draw_points(axes: Any, rows: list[dict[str, Any]]) -> None:
    names: dict[str, int] = {}
    for row in rows:
        error = max(row["max_error"], LEAST_ERROR)
        label = row.get("setting") or f"{row['workload']} {row['pass']}"
        if row["workload"] in ("W3", "W4"):
            label += f", {row['splats'] // 1000}k"
        number = names.setdefault(label, len(names) + 1)
        axes.plot(
            row["ms"],
            error,
            MARKERS[row["error_of"]],
            color=COLORS[row["backend"]],
            markersize=7,
            alpha=0.8,
        )
        axes.annotate(
            str(number), (row["ms"], error), textcoords="offset points", xytext=(5, 4), fontsize=8
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("time, ms")
    axes.set_ylabel("largest error against the f64 reference")
    axes.grid(alpha=0.3)
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=COLORS[b], marker="s", linestyle="", label=b)
        for b in COLORS
        if any(row["backend"] == b for row in rows)
    ]
    handles += [
        Line2D([], [], color="#888888", marker=marker, linestyle="", label=f"of {what}")
        for what, marker in MARKERS.items()
        if any(row["error_of"] == what for row in rows)
    ]
    handles += [
        Line2D([], [], linestyle="", label=f"{number}  {label}") for label, number in names.items()
    ]
    axes.legend(
        handles=handles, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False
    )


def _draw_growth(axes: list[Any], rows: list[dict[str, Any]]) -> None:
    from .growth import GROWN_COUNT, GROWN_SIDE

    panels = (
        ("splats", lambda row: row["width"] == GROWN_SIDE, f"{GROWN_SIDE} x {GROWN_SIDE} pixels"),
        ("width", lambda row: row["splats"] == GROWN_COUNT, f"{GROWN_COUNT} splats"),
    )
    backends = [b for b in COLORS if any(row["backend"] == b for row in rows)]
    for axis, (key, chosen, what) in zip(axes, panels, strict=False):
        for backend in backends:
            line = sorted(
                (row[key], row["ms"]) for row in rows if chosen(row) and row["backend"] == backend
            )
            if line:
                axis.plot(*zip(*line, strict=True), "o-", color=COLORS[backend], label=backend)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("splats" if key == "splats" else "side of the picture, pixels")
        axis.set_ylabel("time per fit step, ms")
        axis.set_title(what, fontsize=9)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    axis = axes[2]
    for backend in backends:
        line = sorted(
            (row["splats"], row["bytes_per_splat"])
            for row in rows
            if row["width"] == GROWN_SIDE and row["backend"] == backend
        )
        axis.plot(*zip(*line, strict=True), "o-", color=COLORS[backend], label=backend)
    allowed = rows[0]["contract_bytes_per_splat"]
    axis.axhline(allowed, color="#444444", linestyle="--", linewidth=1)
    axis.annotate(
        "2 x parameters + gradients + optimiser state",
        (0.02, allowed),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        xytext=(0, 3),
        fontsize=8,
    )
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("splats")
    axis.set_ylabel("peak memory, bytes per splat, less the picture's")
    axis.grid(alpha=0.3)
    for unused in axes[3:]:
        unused.set_visible(False)
