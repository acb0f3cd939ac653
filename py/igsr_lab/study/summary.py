"""Means and spreads of a study's fits: ``study.json``, a Markdown table and a plot."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr_lab.study.markdown_table import markdown_table
from igsr_lab.study.study_files import headed, text_of, write_study_files

#: Scores in the order of the table: how they are headed and written. Not every study has all.
SCORES = {
    "psnr": ("PSNR, dB", ".2f"),
    "psnr_refined": ("refined PSNR, dB", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "flip": ("FLIP", ".4f"),
    "cc_psnr": ("cc PSNR, dB", ".2f"),
    "cc_ssim": ("cc SSIM", ".4f"),
    "splats": ("splats", ".0f"),
    "seconds": ("seconds a fit", ".0f"),
}


def summarized(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean of each score over the rows; its spread over seeds, each seed's rows averaged first."""
    out: dict[str, Any] = {"fits": len(rows)}
    for score in (score for score in SCORES if all(score in row for row in rows)):
        by_seed: dict[int, list[float]] = {}
        for row in rows:
            by_seed.setdefault(row["seed"], []).append(row[score])
        means = [float(np.mean(values)) for values in by_seed.values()]
        out[score] = float(np.mean(means))
        out[f"{score}_spread"] = float(np.std(means, ddof=1)) if len(means) > 1 else None
    return out


def write_study(
    out: Path, title: str, rows: list[dict[str, Any]], protocol: dict[str, Any]
) -> dict[str, Any]:
    """Write ``study.json``, ``study.md`` and ``study.png`` into ``out``; returns the first's data.

    Raises:
        IgsrError: a file cannot be written.
    """
    presets = dict.fromkeys(row["preset"] for row in rows)
    scenes: dict[str, dict[str, dict[str, Any]]] = {}
    for scene, views in dict.fromkeys((row["scene"], row["views"]) for row in rows):
        same = [row for row in rows if (row["scene"], row["views"]) == (scene, views)]
        scenes.setdefault(scene, {})[views] = _by_preset(same, presets)
    report = {
        "title": title,
        "igsr": _core.__version__,
        "protocol": protocol,
        "mean": _by_preset(rows, presets),
        "scenes": scenes,
        "runs": rows,
    }
    write_study_files(out, report, markdown(report))
    _plot(out / "study.png", report)
    return report


def _by_preset(rows: list[dict[str, Any]], presets: Iterable[str]) -> dict[str, Any]:
    return {
        preset: summarized([row for row in rows if row["preset"] == preset]) for preset in presets
    }


def _groups(report: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Scene, views and the summaries by preset of every kind of fit, in order."""
    return [
        (scene, views, presets)
        for scene, by_views in report["scenes"].items()
        for views, presets in by_views.items()
    ]


def markdown(report: dict[str, Any]) -> str:
    """The table of a study, mean ± spread over seeds."""
    shown = [score for score in SCORES if score in next(iter(report["mean"].values()))]
    rows = [
        [scene, views, preset, *(_with_spread(scores, score) for score in shown)]
        for scene, views, presets in [*_groups(report), ("mean", "all", report["mean"])]
        for preset, scores in presets.items()
    ]
    heads = ["scene", "views", "preset", *(SCORES[score][0] for score in shown)]
    return text_of([*headed(report), *markdown_table(heads, rows, left=3)])


def _with_spread(scores: dict[str, Any], score: str) -> str:
    form, spread = SCORES[score][1], scores[f"{score}_spread"]
    return format(scores[score], form) + ("" if spread is None else f" ± {spread:{form}}")


def _plot(path: Path, report: dict[str, Any]) -> None:
    """PSNR of every fit, by scene, views and preset."""
    from matplotlib.figure import Figure

    groups = _groups(report)
    figure = Figure(figsize=(1.5 + 1.3 * len(groups), 4.0), layout="constrained")
    axis = figure.subplots()
    presets = list(report["mean"])
    for k, preset in enumerate(presets):
        for g, (scene, views, summaries) in enumerate(groups):
            psnrs = [
                row["psnr"]
                for row in report["runs"]
                if (row["scene"], row["views"], row["preset"]) == (scene, views, preset)
            ]
            at = g + 0.5 * (k + 0.5) / len(presets) - 0.25
            axis.plot([at] * len(psnrs), psnrs, "o", color=f"C{k}", alpha=0.6)
            mean = summaries[preset]["psnr"]
            label = preset if g == 0 else None
            axis.plot(at, mean, "_", markersize=16, markeredgewidth=2, color=f"C{k}", label=label)
    axis.set_xticks(
        range(len(groups)), [f"{scene}\nviews {views}" for scene, views, _ in groups], fontsize=8
    )
    axis.set_xlim(-0.5, len(groups) - 0.5)
    axis.set_ylabel("PSNR of held-out views, dB")
    axis.set_title(report["title"], fontsize=10)
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=9)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
