"""Report of a refinement study: means over seeds, paired gains, a plot and sheets of pictures."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr_lab.report_parts import cell, markdown_table, new_figure, save_figure, write_sheet
from igsr_lab.study.refinement_methods import Method
from igsr_lab.study.refinement_runs import RefinementRun
from igsr_lab.study.study import SCORE_COLUMNS, Row, deviation, difference_cell, standard_error

#: Scores of the tables.
SCORES = ("psnr", "ssim", "flip", "perceptual")
GAINS_TEXT = (
    "Gain of the last round over round 0, with its standard error over held-out views; "
    "in brackets the standard deviation over seeds:"
)
PAPER_TEXT = "The paper's own figures (PSNR / SSIM / LPIPS, 5 000 iterations, DUSt3R poses):"


def summarized(rows: Sequence[Row]) -> Row:
    """Mean scores after each round, by method; a run that stopped keeps its last scores.

    "near" and "far" are the PSNR of held-out views near a photo and far from all, "done" the
    fraction of runs that did the round, "spread" the standard deviation of "psnr".
    """
    summary: Row = {}
    for method in rows[0]["methods"]:
        runs = [row["methods"][method]["rounds"] for row in rows]
        rounds = []
        for number in range(max(len(run) for run in runs)):
            done = [run[min(number, len(run) - 1)] for run in runs]
            means: Row = {
                name: float(np.mean([row[name] for row in done]))
                for name in SCORES
                if all(name in row for row in done)
            }
            for name in ("near", "far"):
                known = [row[name]["psnr"] for row in done if row[name]]
                means[name] = float(np.mean(known)) if known else None
            means["done"] = float(np.mean([len(run) > number for run in runs]))
            means["spread"] = float(np.std([row["psnr"] for row in done]))
            rounds.append(means)
        summary[method] = {"runs": len(runs), "rounds": rounds}
    return summary


def paired_gains(rows: Sequence[Row], method: str) -> dict[str, Row]:
    """Gain of a method's last round over the first fit, by score.

    Args:
        rows: runs of the same photos with different seeds. Seeds are averaged for each held-out
            view first, since views of several seeds are not independent.
        method: name of a method.

    Returns:
        By score "gain", its "standard_error" over held-out views, and "seeds", the standard
        deviation of the runs' mean gains; None if there is only one view or run.
    """
    runs = [row["methods"][method]["rounds"] for row in rows]
    gains: dict[str, Row] = {}
    for name in SCORES:
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
            "standard_error": standard_error(means),
            "seeds": deviation(by_view.mean(axis=1)),
        }
    return gains


def mean_gains(gains: Sequence[dict[str, Row]]) -> dict[str, Row]:
    """Mean gains over several choices of photos, with their standard errors."""
    means: dict[str, Row] = {}
    for name in SCORES:
        known = np.array([by_score[name]["gain"] for by_score in gains if name in by_score])
        if len(known):
            means[name] = {"gain": float(known.mean()), "standard_error": standard_error(known)}
    return means


def table_lines(report: Row) -> list[str]:
    """Scores after each round, gains, and the paper's figures."""
    groups = _groups(report)
    names = [name for name in SCORES if name in groups[0][3][0]]
    rows = [
        [
            *group,
            number,
            "" if number == 0 else f"{100.0 * row['done']:.0f} %",
            *(format(row[name], SCORE_COLUMNS[name][1]) for name in names),
            *(cell(row[name], ".2f") for name in ("near", "far")),
        ]
        for *group, rounds in groups
        for number, row in enumerate(rounds)
    ]
    heads = ["scene", "photos", "method", "round", "done"]
    heads += [*(SCORE_COLUMNS[name][0] for name in names), "near, dB", "far, dB"]
    lines = [*markdown_table(heads, rows, left=3), "", GAINS_TEXT, "", *_gain_lines(report)]
    if report["paper"]:
        lines += ["", PAPER_TEXT, "", *(f"* {row}" for row in report["paper"])]
    return lines


def _gain_lines(report: Row) -> list[str]:
    means = report["mean_gains"]
    names = [name for name in SCORES if all(name in gains for gains in means.values())]
    gains_of = [
        ([scene, photos, method], gains)
        for scene, by_photos in report["gains"].items()
        for photos, methods in by_photos.items()
        for method, gains in methods.items()
    ] + [(["mean", "", method], gains) for method, gains in means.items()]

    def written(name: str, gain: Row | None) -> str:
        if gain is None:
            return "-"
        error, seeds = gain["standard_error"], gain.get("seeds")
        return difference_cell(gain["gain"], error, seeds, SCORE_COLUMNS[name][1])

    rows = [
        [*group, *(written(name, gains.get(name)) for name in names)] for group, gains in gains_of
    ]
    heads = ["scene", "photos", "method", *(SCORE_COLUMNS[name][0] for name in names)]
    return markdown_table(heads, rows, left=3)


def _groups(report: Row) -> list[tuple[str, str, str, list[Row]]]:
    """Scene, photos, method and rounds."""
    return [
        (scene, photos, method, summary["rounds"])
        for scene, by_photos in report["scenes"].items()
        for photos, methods in by_photos.items()
        for method, summary in methods.items()
    ]


def plot_rounds(path: Path, report: Row) -> None:
    """Plot the PSNR of held-out views over the rounds, with a panel per scene and photos."""
    groups = _groups(report)
    panels = list(dict.fromkeys((scene, photos) for scene, photos, _, _ in groups))
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(3.6 * columns + 0.4, 3.0 * rows + 0.3)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, panel in zip(axes.flat, panels, strict=False):
        for scene, photos, method, rounds in groups:
            if (scene, photos) == panel:
                axis.plot([row["psnr"] for row in rounds], "o-", markersize=4, label=method)
        axis.set_title(", ".join(panel), fontsize=9)
        axis.set_xlabel("round")
        axis.set_ylabel("PSNR of held-out views, dB")
        axis.xaxis.get_major_locator().set_params(integer=True)
        axis.grid(alpha=0.3)
    axes.flat[0].legend(fontsize=8)
    figure.suptitle(report["title"], fontsize=10)
    save_figure(figure, path)


def write_run_sheet(out: Path, run: RefinementRun, methods: Sequence[Method]) -> None:
    """Draw a held-out view after each round, and the two added views of the largest gain."""
    folder = out / "rounds" / run.name
    truth, first = _picture(folder / "truth.png"), _picture(folder / "first.png")
    if truth is None or first is None:
        warnings.warn(f"{folder} has no pictures: no sheet of {run.name} is drawn.", stacklevel=4)
        return
    sheet = {}
    for method in methods:
        row = {"truth": truth, "round 0": first}
        shown = first
        for number in range(1, max(method.rounds for method in methods) + 1):
            after = _picture(folder / method.name / f"round{number}.png")
            shown = shown if after is None else after
            row[f"round {number}"] = shown
        for k in range(min(2, max(method.views for method in methods))):
            added = _picture(folder / method.name / "rounds" / "1" / f"view-{k}.after.png")
            row[f"added view {k + 1}"] = np.full_like(truth, 255) if added is None else added
        sheet[method.name] = row
    write_sheet(out / f"{run.scene}-{run.layout}{run.photos}.png", sheet)


def _picture(path: Path) -> npt.NDArray[np.uint8] | None:
    if not path.is_file():
        return None
    with Image.open(path) as picture:
        return np.asarray(picture)
