"""Tables, differences and the plot of ``own_photos``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr_lab.study.markdown_table import cell, markdown_table
from igsr_lab.study.study_files import headed, text_of, write_study_files

#: Columns of the table of scores: how they are headed and written.
SCORES = {
    "psnr": ("PSNR, dB", ".2f"),
    "psnr_refined": ("refined PSNR, dB", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "ms_ssim": ("MS-SSIM", ".4f"),
    "flip": ("FLIP", ".4f"),
    "cc_psnr": ("cc PSNR, dB", ".2f"),
    "cc_ssim": ("cc SSIM", ".4f"),
    "perceptual": ("perceptual", ".4f"),
    "lh_psnr": ("left-half PSNR, dB", ".2f"),
    "lh_ssim": ("left-half SSIM", ".4f"),
    "train_psnr": ("train PSNR, dB", ".2f"),
    "train_ssim": ("train SSIM", ".4f"),
    "splats": ("splats", ".0f"),
    "seconds": ("seconds", ".0f"),
    "cpu_seconds": ("CPU seconds", ".0f"),
    "peak_memory_bytes": ("peak, GiB", ".2f"),
}
#: Scores of held-out photos whose differences are told.
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
#: Of runs, whose differences are told, too.
COMPARED_RUNS = ("train_psnr", "train_ssim", "splats", "seconds", "cpu_seconds")
HEADS = {**{name: head for name, (head, _) in SCORES.items()}, "ssim_refined": "refined SSIM"}
FORMATS = {**{name: form for name, (_, form) in SCORES.items()}, "ssim_refined": ".4f"}
DIFFERENCES_TEXT = (
    "A photo's difference is the mean over seeds of its score after minus before. A scene's is the "
    "mean over its held-out photos, ± its standard error over them; in brackets the standard "
    "deviation over seeds of the scene's difference. The last line is the mean over scenes, ± its "
    "standard error over them."
)


def write_report(
    out: Path,
    rows: list[dict[str, Any]],
    cameras: dict[str, dict[str, Any]],
    presets: Sequence[str],
    protocol: dict[str, Any],
) -> dict[str, Any]:
    """Write ``study.json``, ``study.md`` and ``study.png``; returns what the first holds.

    Args:
        out: folder to write to.
        rows: of all fits.
        cameras: the rows of the scenes whose cameras were looked for, by scene.
        presets: that were fitted; of two, the first is "before".
        protocol: what was done.

    Raises:
        IgsrError: a file cannot be written.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    report = {
        "title": "Own photos, end to end",
        "igsr": _core.__version__,
        "protocol": protocol,
        "mean": {one: _summary(_of(rows, preset=one)) for one in presets if rows},
        "scenes": {
            scene: {one: _summary(_of(rows, scene=scene, preset=one)) for one in presets}
            for scene in scenes
        },
        "differences": differences(rows, *presets) if len(presets) == 2 and rows else None,
        "cameras": list(cameras.values()),
        "runs": rows,
    }
    write_study_files(out, report, markdown(report))
    if rows:
        _plot(out / "study.png", report)
    return report


def differences(rows: list[dict[str, Any]], before: str, after: str) -> dict[str, Any]:
    """Paired differences, after minus before, over scenes, seeds and held-out photos.

    Args:
        rows: of all fits: each scene has the same seeds and held-out photos for both presets.
        before, after: the presets.

    Returns:
        "before", "after", "scenes": for each scene and score "mean", "error" (standard error over
        held-out photos, None for one photo or what has no value for each photo), "seeds" (standard
        deviation over seeds, None for one seed), and "mean": for each score "mean" over scenes and
        "error" over them.
    """
    by_scene: dict[str, dict[str, Any]] = {}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        pairs = list(
            zip(
                *(
                    sorted(_of(rows, scene=scene, preset=one), key=lambda row: int(row["seed"]))
                    for one in (before, after)
                ),
                strict=True,
            )
        )
        of_scene: dict[str, Any] = {}
        for score in COMPARED:
            # By seed and photo; a score that a photo does not have leaves it out.
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
                    "seeds": _deviation(table.mean(axis=1)),
                }
        for score in COMPARED_RUNS:
            each = np.array([second[score] - first[score] for first, second in pairs], np.float64)
            of_scene[score] = {
                "mean": float(each.mean()),
                "error": None,
                "seeds": _deviation(each),
            }
        by_scene[scene] = of_scene
    mean = {}
    for score in (*COMPARED, *COMPARED_RUNS):
        known = np.array([one[score]["mean"] for one in by_scene.values() if score in one])
        if len(known):
            mean[score] = {"mean": float(known.mean()), "error": standard_error(known)}
    return {"before": before, "after": after, "scenes": by_scene, "mean": mean}


def standard_error(values: np.ndarray) -> float | None:
    """Standard error of the mean of some values; None for a single one."""
    deviation = _deviation(values)
    return None if deviation is None else deviation / float(np.sqrt(len(values)))


def _deviation(values: np.ndarray) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _of(rows: Iterable[dict[str, Any]], **values: Any) -> list[dict[str, Any]]:
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean of each score over the rows, each scene counting once; its spread over seeds."""
    out: dict[str, Any] = {"fits": len(rows)}
    for score in SCORES:
        by_seed: dict[int, list[float]] = {}
        for row in rows:
            if row.get(score) is not None:
                by_seed.setdefault(row["seed"], []).append(row[score])
        means = np.array([np.mean(values) for values in by_seed.values()])
        out[score] = float(means.mean()) if len(means) else None
        out[f"{score}_spread"] = _deviation(means)
    return out


def markdown(report: dict[str, Any]) -> str:
    """``study.md``: scores, differences, what limits each scene, seconds and memory."""
    lines = headed(report)
    if report["runs"]:
        lines += _score_lines(report)
    if report["differences"]:
        lines += _difference_lines(report["differences"])
    if report["runs"]:
        lines += _limit_lines(report)
        lines += _part_lines(report)
    failed = [row for row in report["cameras"] if row["failed"]]
    if failed:
        lines += ["", "## Scenes without cameras", ""]
        lines += [f"* {row['scene']}: {row['failed']}" for row in failed]
    return text_of(lines)


def _score_lines(report: dict[str, Any]) -> list[str]:
    shown = [name for name in SCORES if any(row.get(name) is not None for row in report["runs"])]
    groups = [*report["scenes"].items(), ("mean", report["mean"])]
    rows = [
        [scene, _photos(report, scene), preset, *(_with_spread(scores, name) for name in shown)]
        for scene, by_preset in groups
        for preset, scores in by_preset.items()
    ]
    heads = ["scene", "photos placed", "preset", *(HEADS[name] for name in shown)]
    return ["Means ± spread over seeds.", "", *markdown_table(heads, rows, left=3)]


def _photos(report: dict[str, Any], scene: str) -> str:
    row = next((row for row in report["runs"] if row["scene"] == scene), None)
    return "all" if row is None else f"{row['placed']} of {row['photos']}"


def _with_spread(scores: dict[str, Any], name: str) -> str:
    value, spread = scores[name], scores[f"{name}_spread"]
    if value is None:
        return "-"
    if name == "peak_memory_bytes":
        value, spread = value / 2**30, None
    form = FORMATS[name]
    return format(value, form) + ("" if spread is None else f" ± {spread:{form}}")


def _difference_lines(found: dict[str, Any]) -> list[str]:
    shown = [name for name in (*COMPARED, *COMPARED_RUNS) if name in found["mean"]]

    def written(name: str, value: dict[str, Any] | None) -> str:
        if value is None:
            return "-"
        form = FORMATS[name]
        text = format(value["mean"], f"+{form}")
        if value["error"] is not None:
            text += f" ± {value['error']:{form}}"
        if value.get("seeds") is not None:
            text += f" ({value['seeds']:{form}})"
        return text

    rows = [
        [scene, *(written(name, values.get(name)) for name in shown)]
        for scene, values in [*found["scenes"].items(), ("mean of scenes", found["mean"])]
    ]
    heads = ["scene", *(HEADS[name] for name in shown)]
    title = f"## {found['after']} minus {found['before']}"
    return ["", title, "", DIFFERENCES_TEXT, "", *markdown_table(heads, rows, left=1)]


def _limit_lines(report: dict[str, Any]) -> list[str]:
    lines = ["", "## What limits each scene", "", "By the fit with seed 0.", ""]
    return lines + [
        f"* {row['scene']}, {row['preset']}: {row['limit']['sentence']}"
        for row in report["runs"]
        if row["seed"] == 0
    ]


def _part_lines(report: dict[str, Any]) -> list[str]:
    names = list(dict.fromkeys(name for row in report["runs"] for name in row["parts"]))
    rows = []
    for scene, by_preset in report["scenes"].items():
        for preset in by_preset:
            same = _of(report["runs"], scene=scene, preset=preset)
            fit, scored = same[0]["fit_size"], same[0]["score_size"]
            cells = [scene, preset, f"{fit[0]}×{fit[1]}", f"{scored[0]}×{scored[1]}"]
            for name in names:
                parts = [row["parts"][name] for row in same if name in row["parts"]]
                cells.append(_part_cell(parts) if parts else "-")
            rows.append(cells)
    heads = ["scene", "preset", "fitted at", "scored at", *names]
    about = "Seconds (CPU seconds), peak memory; means over seeds. Cameras are found once a scene."
    title = "## Seconds and memory of each part"
    return ["", title, "", about, "", *markdown_table(heads, rows, left=2)]


def _part_cell(parts: list[dict[str, Any]]) -> str:
    seconds, cpu = (
        float(np.mean([part[name] for part in parts])) for name in ("seconds", "cpu_seconds")
    )
    peaks = [part["peak_memory_bytes"] for part in parts if part["peak_memory_bytes"] is not None]
    peak = max(peaks) / 2**30 if peaks else None
    return f"{seconds:.1f} ({cpu:.1f}), {cell(peak, '.2f')} GiB"


def _plot(path: Path, report: dict[str, Any]) -> None:
    """PSNR of held-out photos by scene and preset, and the paired differences."""
    from matplotlib.figure import Figure

    scenes, found = list(report["scenes"]), report["differences"]
    panels = 1 if found is None else 2
    figure = Figure(figsize=(2.0 + 1.1 * len(scenes) * panels, 4.2), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    presets = list(report["mean"])
    for k, preset in enumerate(presets):
        for g, scene in enumerate(scenes):
            at = g + 0.5 * (k + 0.5) / len(presets) - 0.25
            for name, marker in (("psnr", "o"), ("train_psnr", "^")):
                values = [row[name] for row in _of(report["runs"], scene=scene, preset=preset)]
                label = None
                if g == 0:
                    label = preset if name == "psnr" else f"{preset}, fitted photos"
                filled = {"markerfacecolor": "none"} if name == "train_psnr" else {}
                axes[0].plot(
                    [at] * len(values), values, marker, color=f"C{k}", alpha=0.7, label=label,
                    **filled,
                )  # fmt: skip
    axes[0].set_ylabel("PSNR, dB; held-out photos filled")
    axes[0].set_title(report["title"], fontsize=10)
    axes[0].legend(fontsize=8)
    if found is not None:
        for g, scene in enumerate(scenes):
            pairs = zip(
                *(_of(report["runs"], scene=scene, preset=one) for one in presets), strict=True
            )
            each = [
                after["psnr"] - before["psnr"]
                for first, second in pairs
                for before, after in zip(first["views"], second["views"], strict=True)
            ]
            axes[1].plot([g] * len(each), each, "o", color="0.6", alpha=0.5, markersize=4)
            value = found["scenes"][scene]["psnr"]
            axes[1].errorbar(g, value["mean"], yerr=value["error"], fmt="_", color="C3", capsize=4)
        axes[1].axhline(0.0, color="0.3", linewidth=0.8)
        axes[1].set_ylabel("difference of PSNR, dB, each held-out photo and seed")
        axes[1].set_title(f"{found['after']} minus {found['before']}", fontsize=10)
    for axis in axes:
        axis.set_xticks(range(len(scenes)), scenes, fontsize=8, rotation=20, ha="right")
        axis.set_xlim(-0.5, len(scenes) - 0.5)
        axis.grid(alpha=0.3, axis="y")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
