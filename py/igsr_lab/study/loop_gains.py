"""What the rounds of a loop gain over its first fit, paired by held-out view and seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from igsr_lab.study.loop_tables import COLUMNS


def paired_gains(rows: Sequence[dict[str, Any]], method: str) -> dict[str, dict[str, float | None]]:
    """What a method's last round is better than the first fit, by score.

    Seeds are averaged for each held-out view first, since views of several seeds are not
    independent.

    Args:
        rows: runs of the same photos with different seeds.
        method: name of a method that all runs have.

    Returns:
        By score "gain", its "standard_error" over held-out views (None for a single one) and
        "seeds", the standard deviation of the runs' mean gains (None for a single one).
    """
    runs = [row["methods"][method]["rounds"] for row in rows]
    gains: dict[str, dict[str, float | None]] = {}
    for name in COLUMNS:
        if any(view.get(name) is None for run in runs for view in run[0]["views"]):
            continue
        by_view = np.array(
            [
                [
                    after[name] - before[name]
                    for before, after in zip(run[0]["views"], run[-1]["views"], strict=True)
                ]
                for run in runs
            ]
        )
        means = by_view.mean(axis=0)
        gains[name] = {
            "gain": float(means.mean()),
            "standard_error": _standard_error(means),
            "seeds": float(by_view.mean(axis=1).std(ddof=1)) if len(runs) > 1 else None,
        }
    return gains


def mean_gains(
    gains: Sequence[dict[str, dict[str, float | None]]],
) -> dict[str, dict[str, float | None]]:
    """The mean of several choices of photos, with its standard error over them."""
    out: dict[str, dict[str, float | None]] = {}
    for name in COLUMNS:
        known = [one[name]["gain"] for one in gains if name in one]
        if known:
            values = np.array(known, np.float64)
            out[name] = {"gain": float(values.mean()), "standard_error": _standard_error(values)}
    return out


def _standard_error(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    if len(values) < 2:
        return None
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def gains_table(report: dict[str, Any]) -> list[str]:
    """Lines of the table of ``report["gains"]``, by scene, photos and method."""
    means = report["mean_gains"]
    shown = [name for name in COLUMNS if all(name in gains for gains in means.values())]
    lines = [
        "Gain of the last round that was kept over round 0, with its standard error over held-out "
        "views; in brackets the standard deviation over seeds:",
        "",
        "| scene | photos | method | " + " | ".join(COLUMNS[name][0] for name in shown) + " |",
        "| --- | --- | --- |" + " ---: |" * len(shown),
    ]
    for scene, by_photos in report["gains"].items():
        for photos, methods in by_photos.items():
            for method, gains in methods.items():
                cells = [_cell(gains.get(name), COLUMNS[name][1]) for name in shown]
                lines.append(f"| {scene} | {photos} | {method} | {' | '.join(cells)} |")
    for method, gains in means.items():
        cells = [_cell(gains[name], COLUMNS[name][1]) for name in shown]
        lines.append(f"| mean | | {method} | {' | '.join(cells)} |")
    return lines


def _cell(gain: dict[str, float | None] | None, form: str) -> str:
    if gain is None:
        return "-"
    text = f"{gain['gain']:+{form}}"
    if gain["standard_error"] is not None:
        text += f" ± {gain['standard_error']:{form}}"
    if gain.get("seeds") is not None:
        text += f" ({gain['seeds']:{form}})"
    return text
