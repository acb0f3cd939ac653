"""What a study's fits come to: ``study.json``, a Markdown table and a plot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .. import _core
from ..atomic_write import atomic_write

SCORES = ("psnr", "ssim", "flip", "splats", "seconds")
FORMATS = {"psnr": ".2f", "ssim": ".4f", "flip": ".4f", "splats": ".0f", "seconds": ".0f"}


def summarized(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean of each score over the rows; its spread over seeds, each seed's rows averaged first."""
    out: dict[str, Any] = {"fits": len(rows)}
    for score in SCORES:
        by_seed: dict[int, list[float]] = {}
        for row in rows:
            by_seed.setdefault(row["seed"], []).append(row[score])
        means = [float(np.mean(values)) for values in by_seed.values()]
        out[score] = float(np.mean(means))
        out[f"{score}_spread"] = float(np.std(means, ddof=1)) if len(means) > 1 else None
    return out


def write_study(
    out: Path,
    title: str,
    rows: list[dict[str, Any]],
    presets: tuple[str, ...],
    scenes: tuple[str, ...],
    protocol: dict[str, Any],
) -> dict[str, Any]:
    """Write ``study.json``, ``study.md`` and ``study.png`` into ``out``; returns the first's data.

    Raises:
        IgsrError: a file cannot be written.
    """
    report = {
        "title": title,
        "igsr": _core.__version__,
        "protocol": protocol,
        "mean": {
            preset: summarized([row for row in rows if row["preset"] == preset])
            for preset in presets
        },
        "scenes": {
            scene: {
                preset: summarized(
                    [row for row in rows if (row["scene"], row["preset"]) == (scene, preset)]
                )
                for preset in presets
            }
            for scene in scenes
        },
        "runs": rows,
    }
    with atomic_write(out / "study.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False), encoding="utf-8")
    with atomic_write(out / "study.md") as temporary:
        temporary.write_text(markdown(report), encoding="utf-8")
    _plot(out / "study.png", report)
    return report


def markdown(report: dict[str, Any]) -> str:
    """The table of a study, mean ± spread over seeds."""
    lines = [
        f"# {report['title']}",
        "",
        f"igsr {report['igsr']}; {json.dumps(report['protocol'])}",
        "",
        "| scene | preset | PSNR, dB | SSIM | FLIP | splats | seconds a fit |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    groups = {**report["scenes"], "mean": report["mean"]}
    for scene, presets in groups.items():
        for preset, scores in presets.items():
            cells = []
            for score in SCORES:
                spread = scores[f"{score}_spread"]
                cell = format(scores[score], FORMATS[score])
                if spread is not None:
                    cell += f" ± {spread:{FORMATS[score]}}"
                cells.append(cell)
            lines.append(f"| {scene} | {preset} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _plot(path: Path, report: dict[str, Any]) -> None:
    """PSNR of every fit, by scene and preset."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.5 + 1.8 * len(report["scenes"]), 4.0), layout="constrained")
    axis = figure.subplots()
    presets = list(report["mean"])
    for k, preset in enumerate(presets):
        for s, scene in enumerate(report["scenes"]):
            rows = [r for r in report["runs"] if (r["scene"], r["preset"]) == (scene, preset)]
            at = s + 0.5 * (k + 0.5) / len(presets) - 0.25
            axis.plot(
                [at] * len(rows), [row["psnr"] for row in rows], "o", color=f"C{k}", alpha=0.6
            )
            mean = report["scenes"][scene][preset]["psnr"]
            label = preset if s == 0 else None
            axis.plot(at, mean, "_", markersize=16, markeredgewidth=2, color=f"C{k}", label=label)
    axis.set_xticks(range(len(report["scenes"])), list(report["scenes"]))
    axis.set_xlim(-0.5, len(report["scenes"]) - 0.5)
    axis.set_ylabel("PSNR of held-out views, dB")
    axis.set_title(report["title"], fontsize=10)
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=9)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
