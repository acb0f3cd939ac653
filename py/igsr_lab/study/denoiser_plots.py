"""Plots of the denoiser study: gains, and confidence against error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.atomic_write import atomic_write


def plot_gains(path: Path, report: dict[str, Any]) -> None:
    """PSNR gain by scene and kind of fit, a bar per denoiser."""
    from matplotlib.figure import Figure

    lines = [
        (f"{scene} {kind}", of_kind)
        for scene, columns in report["scenes"].items()
        for kind, of_kind in columns["kinds"].items()
    ]
    names = ["igsr", *lines[0][1]["others"]]
    figure = Figure(figsize=(2.0 + 0.22 * len(lines) * len(names), 4.2), layout="constrained")
    axis = figure.subplots()
    for k, name in enumerate(names):
        gains = []
        for _, columns in lines:
            scores = columns["after"] if name == "igsr" else columns["others"][name]
            after, before = scores["psnr"], columns["before"]["psnr"]
            # Masks may hide all that would be scored.
            gains.append(np.nan if after is None or before is None else after - before)
        at = np.arange(len(lines)) + (k - 0.5 * (len(names) - 1)) * 0.8 / len(names)
        axis.bar(at, gains, 0.8 / len(names), label=name)
    axis.axhline(0.0, color="black", linewidth=0.8)
    axis.set_xticks(range(len(lines)), [label for label, _ in lines], rotation=60, ha="right")
    axis.set_ylabel("PSNR gain by denoising, dB")
    axis.set_title(report["title"], fontsize=10)
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=8)
    _save(figure, path)


def plot_confidence(path: Path, confidence: dict[str, Any]) -> None:
    """Mean absolute error by predicted confidence, beside what the confidence claims."""
    from matplotlib.figure import Figure

    from igsr.denoiser.confidence import HALF_CONFIDENCE_ERROR

    predicted = np.asarray(confidence["confidence"])
    figure = Figure(figsize=(6.0, 4.2), layout="constrained")
    axis = figure.subplots()
    claimed = HALF_CONFIDENCE_ERROR * (1.0 / np.maximum(predicted, 1e-3) - 1.0)
    axis.plot(predicted, claimed, "--", color="grey", label="as claimed")
    axis.plot(predicted, confidence["error"], "o-", label="measured")
    axis.set_yscale("log")
    axis.set_xlabel("predicted confidence")
    axis.set_ylabel("mean absolute error")
    axis.grid(alpha=0.3, which="both")
    share = figure.axes[0].twinx()
    pixels = np.asarray(confidence["pixels"])
    share.bar(predicted, pixels / pixels.sum(), 0.03, alpha=0.2, color="C2")
    share.set_ylabel("share of the pixels (bars)")
    axis.legend(fontsize=8)
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
