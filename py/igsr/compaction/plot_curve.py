"""Plot of a compaction: loss against number of splats and against bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from igsr._internal.atomic_write import atomic_write

# Distinct in print and for color-blind readers (Okabe and Ito).
WITHIN_COLOR = "#0072b2"
BEYOND_COLOR = "#d55e00"
RESULT_COLOR = "#009e73"


def write_plot(path: Path, report: dict[str, Any]) -> None:
    """Plot the loss against the number of splats and against bytes.

    Args:
        path: the PNG to write.
        report: ``Compaction.report``.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    whole, result = report["whole"], report["result"]
    figure.suptitle(
        f"{whole['splats']} splats, SH {whole['sh_degree']}, to {result['splats']}, "
        f"SH {result['sh_degree']}: {result['loss']:.2f} dB lost, against "
        f"{report['protocol']['against']}, {report['protocol']['validation_views']} views",
        fontsize=10,
        wrap=True,
    )
    axes = figure.subplots(1, 2, sharey=True)
    panels = (("splats", 1.0, "splats"), ("bytes", 1e-6, "size of the .ply, MB"))
    for axis, (key, unit, label) in zip(axes, panels, strict=True):
        best: dict[int, dict[str, Any]] = {}
        for row in sorted(report["curve"], key=lambda row: row["loss"]):
            best.setdefault(row[key], row)
        sizes = sorted(best)
        axis.plot(
            [size * unit for size in sizes],
            [best[size]["loss"] for size in sizes],
            color="#999999",
            linewidth=1,
            zorder=1,
        )
        for row in report["curve"]:
            color = WITHIN_COLOR if row["loss"] <= report["max_loss"] else BEYOND_COLOR
            face = color if row["settled"] else "none"
            axis.plot(row[key] * unit, row["loss"], "o", color=color, markerfacecolor=face)
            if row["sh_degree"] != result["sh_degree"]:
                axis.annotate(
                    f"SH {row['sh_degree']}",
                    (row[key] * unit, row["loss"]),
                    textcoords="offset points",
                    xytext=(6, 4),
                    fontsize=8,
                )
        axis.plot(
            result[key] * unit,
            result["loss"],
            "o",
            markersize=13,
            markerfacecolor="none",
            markeredgecolor=RESULT_COLOR,
            markeredgewidth=2,
            label="result",
        )
        axis.plot([], [], "o", color=WITHIN_COLOR, label="fine-tuned to the end")
        axis.plot(
            [], [], "o", color=WITHIN_COLOR, markerfacecolor="none", label="after a pruning round"
        )
        axis.axhline(
            report["max_loss"], color=BEYOND_COLOR, linestyle="--", linewidth=1, label="--max-loss"
        )
        axis.set_xscale("log")
        axis.set_xlabel(label)
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("PSNR lost, dB")
    axes[0].legend(fontsize=9)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
