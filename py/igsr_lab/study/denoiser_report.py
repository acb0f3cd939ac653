"""The report of the denoiser study: means by scene and kind of fit, and the table of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from igsr import _core
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.study.artifact_likeness import Likeness
from igsr_lab.study.cleaned_renders import SCORES, Cleaned, Scores, mean_scores
from igsr_lab.study.degraded_fits import FEW, NOISE, PAPER, SCORED_VIEWS, DegradedFit, described
from igsr_lab.study.markdown_table import cell, markdown_table
from igsr_lab.study.study_files import headed, text_of

#: The denoiser that comes with igsr, as tables call it, and the renders as they are.
OURS, BEFORE = "igsr", "before"
#: How scores are headed and written in the table.
COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "ms_ssim": ("MS-SSIM", ".4f"),
    "best_quarter": ("best quarter", ".2f"),
    "flip": ("FLIP", ".4f"),
    "perceptual": ("perceptual", ".4f"),
}


@dataclass(frozen=True, eq=False)
class ComparedFit:
    """One degraded fit, and what each denoiser makes of its renders.

    Attributes:
        fit: which fit.
        row: of the fit's file, as "runs" of the report repeats it.
        cleaned: by denoiser; ``BEFORE`` is first, ``OURS`` among them.
    """

    fit: DegradedFit
    row: Mapping[str, Any]
    cleaned: Mapping[str, Cleaned]


def comparison_report(
    compared: Sequence[ComparedFit],
    scene_names: Mapping[str, str],
    kinds: Sequence[str],
    seeds: int,
    perceptual: bool,
    artifacts: Likeness | None,
) -> dict[str, Any]:
    """What ``study.json`` holds; see ``denoiser_table``.

    Args:
        compared: all fits.
        scene_names: what the report calls each scene.
        kinds: of degraded fits, in the order of the report.
        seeds: how many.
        perceptual: whether there is a perceptual distance.
        artifacts: how alike the errors are to the training pairs', if that was asked.
    """

    def of(scene: str | None = None, of_kinds: Sequence[str] = kinds) -> dict[str, Any]:
        return _means_by_denoiser(
            [one for one in compared if scene in (None, one.fit.scene) and one.fit.kind in of_kinds]
        )

    groups = {
        "sparse": [kind for kind in kinds if kind in FEW],
        NOISE: [kind for kind in kinds if kind == NOISE],
        PAPER: [kind for kind in kinds if kind == PAPER],
    }
    report = {
        "title": "Renders of degraded reconstructions, before and after denoising",
        "igsr": _core.__version__,
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
        "mean": {group: of(None, members) for group, members in groups.items() if members},
        "confidence": _confidence(compared),
        "runs": [
            {**one.row, **{name: cleaned.scores for name, cleaned in one.cleaned.items()}}
            for one in compared
        ],
    }
    return report if artifacts is None else report | {"artifacts": asdict(artifacts)}


def _means_by_denoiser(compared: Sequence[ComparedFit]) -> dict[str, Any]:
    def mean(name: str) -> Scores:
        return mean_scores(one.cleaned[name].scores for one in compared)

    others = [name for name in compared[0].cleaned if name not in (BEFORE, OURS)]
    return {
        "before": mean(BEFORE),
        "after": mean(OURS),
        "others": {name: mean(name) for name in others},
    }


def _confidence(compared: Sequence[ComparedFit]) -> dict[str, Any]:
    """Confidence of igsr's denoiser and the error that remains, over the bins that have pixels."""
    found = [one.cleaned[OURS].confidence for one in compared]
    fits = [one for one in found if one is not None]
    pixels, confidence, error = (
        np.sum([getattr(one, name) for one in fits], axis=0)
        for name in ("pixels", "confidence", "error")
    )
    filled = pixels > 0
    return {
        "confidence": (confidence[filled] / pixels[filled]).tolist(),
        "error": (error[filled] / pixels[filled]).tolist(),
        "pixels": pixels[filled].tolist(),
        "mean_error": float(np.mean([one.mean_error for one in fits])),
        "weighted_error": float(np.mean([one.weighted_error for one in fits])),
    }


def markdown(report: dict[str, Any]) -> str:
    """``study.md``: one line per scene, kind of fit and denoiser, then the means."""
    groups = [
        (scene, kind, of_kind)
        for scene, columns in report["scenes"].items()
        for kind, of_kind in columns["kinds"].items()
    ] + [("mean", group, columns) for group, columns in report["mean"].items()]
    rows = [
        [scene, kind, name, *(cell(scores[key], COLUMNS[key][1]) for key in SCORES)]
        for scene, kind, columns in groups
        for name, scores in {
            BEFORE: columns["before"],
            OURS: columns["after"],
            **columns["others"],
        }.items()
    ]
    heads = ["scene", "fit", "denoiser", *(COLUMNS[key][0] for key in SCORES)]
    confidence = report["confidence"]
    lines = [
        *headed(report),
        *markdown_table(heads, rows, left=3),
        "",
        f"Mean absolute error of cleaned pixels {confidence['mean_error']:.4f}, weighted by their "
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
    return text_of(lines)
