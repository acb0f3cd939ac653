"""Report of ``denoiser_table``: means by scene and kind of fit, a table and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from igsr.denoiser.confidence import HALF_CONFIDENCE_ERROR
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.report_parts import cell, markdown_table, new_figure, save_figure
from igsr_lab.study.artifact_likeness import Likeness
from igsr_lab.study.cleaned_renders import SCORES, Scores
from igsr_lab.study.degraded_fits import FEW, NOISE, PAPER, SCORED_VIEWS, DegradedFit, described
from igsr_lab.study.scoring import known_means
from igsr_lab.study.study import SCORE_COLUMNS, Row

#: Names of igsr's denoiser and of the renders themselves in tables.
OURS, BEFORE = "igsr", "before"
#: Columns of the table with their formats.
COLUMNS = SCORE_COLUMNS | {"best_quarter": ("best quarter, dB", ".2f")}


@dataclass(frozen=True, eq=False)
class ComparedFit:
    """One degraded fit, its row, and the rows of ``run_cleaning`` by denoiser."""

    fit: DegradedFit
    row: Row
    cleaned: Mapping[str, Row]


def comparison_report(
    compared: Sequence[ComparedFit],
    scene_names: Mapping[str, str],
    kinds: Sequence[str],
    seeds: int,
    perceptual: bool,
    artifacts: Likeness | None,
) -> Row:
    """Return the content of ``study.json``; see ``denoiser_table``."""

    def of(scene: str | None = None, of_kinds: Sequence[str] = kinds) -> Row:
        return _means_by_denoiser(
            [one for one in compared if scene in (None, one.fit.scene) and one.fit.kind in of_kinds]
        )

    groups = {"sparse": FEW, NOISE: (NOISE,), PAPER: (PAPER,)}
    members = {name: [kind for kind in kinds if kind in group] for name, group in groups.items()}
    report = {
        "title": "Renders of degraded reconstructions, before and after denoising",
        "protocol": {
            "name": "denoiser-table",
            "kinds": {kind: described(kind) for kind in kinds},
            "views": f"at most {SCORED_VIEWS} held-out views of each scene",
            "seeds": seeds,
            "perceptual": SqueezeNetDistance.name if perceptual else None,
            "best_quarter": "PSNR of the quarter of each view's pixels nearest the truth before",
            "pixels": "8-bit sRGB",
        },
        "scenes": {
            name: of(scene) | {"kinds": {kind: of(scene, [kind]) for kind in kinds}}
            for scene, name in scene_names.items()
        },
        "mean": {name: of(None, some) for name, some in members.items() if some},
        "confidence": _confidence(compared),
        "runs": [
            one.row | {name: {key: row[key] for key in SCORES} for name, row in one.cleaned.items()}
            for one in compared
        ],
    }
    return report if artifacts is None else report | {"artifacts": asdict(artifacts)}


def _means_by_denoiser(compared: Sequence[ComparedFit]) -> Row:
    def mean(name: str) -> Scores:
        return known_means([one.cleaned[name] for one in compared], SCORES)

    others = [name for name in compared[0].cleaned if name not in (BEFORE, OURS)]
    return {
        "before": mean(BEFORE),
        "after": mean(OURS),
        "others": {name: mean(name) for name in others},
    }


def _confidence(compared: Sequence[ComparedFit]) -> Row:
    """Confidence of igsr's denoiser and the remaining error, over the bins that have pixels."""
    fits = [one.cleaned[OURS]["confidence"] for one in compared]
    pixels, confidence, error = (
        np.sum([fit[name] for fit in fits], axis=0) for name in ("pixels", "confidence", "error")
    )
    filled = pixels > 0
    return {
        "confidence": (confidence[filled] / pixels[filled]).tolist(),
        "error": (error[filled] / pixels[filled]).tolist(),
        "pixels": pixels[filled].tolist(),
        "mean_error": float(np.mean([fit["mean_error"] for fit in fits])),
        "weighted_error": float(np.mean([fit["weighted_error"] for fit in fits])),
    }


def _by_name(columns: Row) -> dict[str, Scores]:
    return {BEFORE: columns["before"], OURS: columns["after"], **columns["others"]}


def table_lines(report: Row) -> list[str]:
    """One line per scene, kind of fit and denoiser, then the means."""
    groups = [
        (scene, kind, of_kind)
        for scene, columns in report["scenes"].items()
        for kind, of_kind in columns["kinds"].items()
    ] + [("mean", group, columns) for group, columns in report["mean"].items()]
    rows = [
        [scene, kind, name, *(cell(scores[key], COLUMNS[key][1]) for key in SCORES)]
        for scene, kind, columns in groups
        for name, scores in _by_name(columns).items()
    ]
    heads = ["scene", "fit", "denoiser", *(COLUMNS[key][0] for key in SCORES)]
    confidence = report["confidence"]
    lines = [
        *markdown_table(heads, rows, left=3),
        "",
        f"Mean absolute error of denoised pixels {confidence['mean_error']:.4f}, weighted by their "
        f"confidence {confidence['weighted_error']:.4f}.",
    ]
    if "artifacts" in report:
        apart, within, noise = (
            "unknown" if (octaves := report["artifacts"][name]) is None else f"{octaves:.2f}"
            for name in ("distance", "within", "noise")
        )
        lines += [
            "",
            f"Errors of renders from few photos are {apart} octaves from the training pairs' (two "
            f"halves of those {within} apart, white noise {noise}).",
        ]
    return lines


def plot_gains(path: Path, report: Row) -> None:
    """Plot PSNR gains by scene and kind of fit, with a bar per denoiser."""
    lines = {
        f"{scene} {kind}": _by_name(of_kind)
        for scene, columns in report["scenes"].items()
        for kind, of_kind in columns["kinds"].items()
    }
    names = [name for name in next(iter(lines.values())) if name != BEFORE]
    figure = new_figure(2.0 + 0.22 * len(lines) * len(names), 4.2)
    axis = figure.subplots()
    for k, name in enumerate(names):
        gains = []
        for scores in lines.values():
            after, before = scores[name]["psnr"], scores[BEFORE]["psnr"]
            gains.append(np.nan if after is None or before is None else after - before)
        at = np.arange(len(lines)) + (k - 0.5 * (len(names) - 1)) * 0.8 / len(names)
        axis.bar(at, gains, 0.8 / len(names), label=name)
    axis.axhline(0.0, color="black", linewidth=0.8)
    axis.set_xticks(range(len(lines)), list(lines), rotation=60, ha="right")
    axis.set_ylabel("PSNR gain by denoising, dB")
    axis.set_title(report["title"], fontsize=10)
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=8)
    save_figure(figure, path)


def plot_confidence(path: Path, confidence: Row) -> None:
    """Plot mean absolute error by predicted confidence, measured and claimed."""
    predicted = np.asarray(confidence["confidence"])
    figure = new_figure(6.0, 4.2)
    axis = figure.subplots()
    claimed = HALF_CONFIDENCE_ERROR * (1.0 / np.maximum(predicted, 1e-3) - 1.0)
    axis.plot(predicted, claimed, "--", color="gray", label="as claimed")
    axis.plot(predicted, confidence["error"], "o-", label="measured")
    axis.set_yscale("log")
    axis.set_xlabel("predicted confidence")
    axis.set_ylabel("mean absolute error")
    axis.grid(alpha=0.3, which="both")
    share = axis.twinx()
    pixels = np.asarray(confidence["pixels"])
    share.bar(predicted, pixels / pixels.sum(), 0.03, alpha=0.2, color="C2")
    share.set_ylabel("share of the pixels (bars)")
    axis.legend(fontsize=8)
    save_figure(figure, path)
