"""Report of ``own_photos``: tables of scores, paired differences and usage, and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr_lab.report_parts import (
    cell,
    draw_psnr,
    label_groups,
    markdown_table,
    new_figure,
    save_figure,
)
from igsr_lab.study.study import (
    SCORE_COLUMNS,
    Row,
    Study,
    by_preset,
    deviation,
    difference_cell,
    grouped,
    standard_error,
    with_spread,
)

#: Scores of held-out photos that are compared.
COMPARED = (
    "psnr",
    "psnr_refined",
    "ssim",
    "ssim_refined",
    "ms_ssim",
    "flip",
    "cc_psnr",
    "cc_ssim",
    "perceptual",
    "lh_psnr",
    "lh_ssim",
)
#: Figures of whole fits that are compared.
COMPARED_FITS = ("train_psnr", "train_ssim", "splats", "seconds", "cpu_seconds")
COLUMNS = SCORE_COLUMNS | {"ssim_refined": ("refined SSIM", ".4f")}
DIFFERENCES_TEXT = (
    "A photo's difference is the mean over seeds of its score after minus before. A scene's is the "
    "mean over its held-out photos, ± its standard error over them; in brackets the standard "
    "deviation over seeds of the scene's difference. The last line is the mean over scenes, ± its "
    "standard error over them."
)
USAGE_TEXT = "Seconds (CPU seconds), peak memory; means over seeds. Cameras are found once a scene."


def write_report(
    study: Study, rows: list[Row], cameras: dict[str, Row], presets: Sequence[str], protocol: Row
) -> Row:
    """Write the study's files; return the content of ``study.json``.

    ``cameras`` has the rows of scenes whose cameras were searched; of two presets, the first is
    "before".
    """

    report = {
        "title": "Own photos, from cameras to scores",
        "protocol": protocol,
        "mean": by_preset(rows, SCORE_COLUMNS),
        "scenes": {
            scene: by_preset(same, SCORE_COLUMNS) for scene, same in grouped(rows, "scene").items()
        },
        "differences": differences(rows, *presets) if len(presets) == 2 and rows else None,
        "cameras": list(cameras.values()),
        "runs": rows,
    }
    if rows:
        _plot(study.out / "study.png", report)
    return study.write(report, table_lines)


def differences(rows: list[Row], before: str, after: str) -> Row:
    """Paired differences of two presets over scenes, seeds and held-out photos.

    Returns:
        "before", "after"; "scenes" by scene and score: "mean", "error" (standard error over
        held-out photos), "seeds" (standard deviation over seeds), None for a single photo or
        seed; and "mean" by score: "mean" over scenes and its "error".
    """
    scenes: dict[str, Row] = {}
    for scene, same in grouped(rows, "scene").items():
        fits = grouped(sorted(same, key=lambda row: int(row["seed"])), "preset")
        pairs = list(zip(fits[before], fits[after], strict=True))
        of_scene: Row = {}
        for score in COMPARED:
            # By seed and photo; photos without the score are left out.
            table = np.array(
                [
                    [
                        np.nan if None in (p := (a.get(score), b.get(score))) else p[1] - p[0]
                        for a, b in zip(first["views"], second["views"], strict=True)
                    ]
                    for first, second in pairs
                ],
                dtype=np.float64,
            )
            table = table[:, np.isfinite(table).all(axis=0)]
            if table.size:
                of_scene[score] = {
                    "mean": float(table.mean()),
                    "error": standard_error(table.mean(axis=0)),
                    "seeds": deviation(table.mean(axis=1)),
                }
        for score in COMPARED_FITS:
            each = np.array([second[score] - first[score] for first, second in pairs], np.float64)
            of_scene[score] = {"mean": float(each.mean()), "error": None, "seeds": deviation(each)}
        scenes[scene] = of_scene
    mean = {}
    for score in (*COMPARED, *COMPARED_FITS):
        known = np.array([values[score]["mean"] for values in scenes.values() if score in values])
        if len(known):
            mean[score] = {"mean": float(known.mean()), "error": standard_error(known)}
    return {"before": before, "after": after, "scenes": scenes, "mean": mean}


def table_lines(report: Row) -> list[str]:
    """Scores, differences, limits, usage and failures."""
    lines: list[str] = []
    if report["runs"]:
        lines += _score_lines(report)
    if report["differences"]:
        lines += _difference_lines(report["differences"])
    if report["runs"]:
        lines += ["", "## Limits of each scene", "", "Of the fit with seed 0.", ""]
        lines += [
            f"* {row['scene']}, {row['preset']}: {row['limit']['sentence']}"
            for row in report["runs"]
            if row["seed"] == 0
        ]
        lines += _usage_lines(report)
    failed = [row for row in report["cameras"] if row["failed"]]
    if failed:
        lines += ["", "## Scenes without cameras", ""]
        lines += [f"* {row['scene']}: {row['failed']}" for row in failed]
    return lines


def _score_lines(report: Row) -> list[str]:
    names = [
        name for name in SCORE_COLUMNS if any(row.get(name) is not None for row in report["runs"])
    ]
    placed = {row["scene"]: f"{row['placed']} of {row['photos']}" for row in report["runs"]}
    rows = [
        [scene, placed.get(scene, "all"), preset, *(_score_cell(scores, n) for n in names)]
        for scene, by_preset in [*report["scenes"].items(), ("mean", report["mean"])]
        for preset, scores in by_preset.items()
    ]
    heads = ["scene", "photos placed", "preset", *(COLUMNS[name][0] for name in names)]
    return ["Means ± spread over seeds.", "", *markdown_table(heads, rows, left=3)]


def _score_cell(scores: Row, name: str) -> str:
    value, spread = scores[name], scores[f"{name}_spread"]
    if value is None:
        return "-"
    if name == "peak_memory_bytes":
        value, spread = value / 2**30, None
    return with_spread(value, spread, COLUMNS[name][1])


def _difference_lines(found: Row) -> list[str]:
    names = [name for name in (*COMPARED, *COMPARED_FITS) if name in found["mean"]]

    def written(name: str, value: Row | None) -> str:
        if value is None:
            return "-"
        form = COLUMNS[name][1]
        return difference_cell(value["mean"], value["error"], value.get("seeds"), form)

    rows = [
        [scene, *(written(name, values.get(name)) for name in names)]
        for scene, values in [*found["scenes"].items(), ("mean of scenes", found["mean"])]
    ]
    heads = ["scene", *(COLUMNS[name][0] for name in names)]
    title = f"## {found['after']} minus {found['before']}"
    return ["", title, "", DIFFERENCES_TEXT, "", *markdown_table(heads, rows, left=1)]


def _usage_lines(report: Row) -> list[str]:
    names = list(dict.fromkeys(name for row in report["runs"] for name in row["parts"]))
    rows = []
    for scene, of_scene in grouped(report["runs"], "scene").items():
        for preset, same in grouped(of_scene, "preset").items():
            sizes = ["×".join(map(str, same[0][name])) for name in ("fit_size", "score_size")]
            parts = [[row["parts"][n] for row in same if n in row["parts"]] for n in names]
            rows.append([scene, preset, *sizes, *(_usage_cell(part) for part in parts)])
    heads = ["scene", "preset", "fitted at", "scored at", *names]
    table = markdown_table(heads, rows, left=2)
    return ["", "## Seconds and memory of each part", "", USAGE_TEXT, "", *table]


def _usage_cell(parts: list[Row]) -> str:
    if not parts:
        return "-"
    seconds, cpu = (
        float(np.mean([part[name] for part in parts])) for name in ("seconds", "cpu_seconds")
    )
    peaks = [part["peak_memory_bytes"] for part in parts if part["peak_memory_bytes"] is not None]
    peak = max(peaks) / 2**30 if peaks else None
    return f"{seconds:.1f} ({cpu:.1f}), {cell(peak, '.2f')} GiB"


def _plot(path: Path, report: Row) -> None:
    """PSNR by scene and preset, and the paired differences."""
    by_scene = grouped(report["runs"], "scene").items()
    groups = {scene: grouped(rows, "preset") for scene, rows in by_scene}
    panels = 1 if report["differences"] is None else 2
    figure = new_figure(2.0 + 1.1 * len(groups) * panels, 4.2)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    draw_psnr(axes[0], groups)
    axes[0].set_title(report["title"], fontsize=10)
    if panels == 2:
        _plot_differences(axes[1], groups, report["differences"])
    for axis in axes:
        label_groups(axis, groups)
    save_figure(figure, path)


def _plot_differences(axis: Any, groups: dict[str, dict[str, list[Row]]], found: Row) -> None:
    for g, (scene, fits) in enumerate(groups.items()):
        each = [
            after["psnr"] - before["psnr"]
            for first, second in zip(*fits.values(), strict=True)
            for before, after in zip(first["views"], second["views"], strict=True)
        ]
        axis.plot([g] * len(each), each, "o", color="0.6", alpha=0.5, markersize=4)
        value = found["scenes"][scene]["psnr"]
        axis.errorbar(g, value["mean"], yerr=value["error"], fmt="_", color="C3", capsize=4)
    axis.axhline(0.0, color="0.3", linewidth=0.8)
    axis.set_ylabel("difference of PSNR, dB, each held-out photo and seed")
    axis.set_title(f"{found['after']} minus {found['before']}", fontsize=10)
