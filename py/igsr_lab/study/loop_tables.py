"""The results of a study of the loop: means over seeds and scenes, a table, a plot and sheets."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr._internal.atomic_write import atomic_write
from igsr_lab.study.loop_methods import Method
from igsr_lab.study.loop_runs import RunSpec
from igsr_lab.study.picture_sheet import write_sheet

#: Scores of the table: their headings and formats.
COLUMNS = {
    "psnr": ("PSNR, dB", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "flip": ("FLIP", ".4f"),
    "perceptual": ("perceptual", ".4f"),
}


def summarized(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """By method, mean scores after each round; a run that stopped keeps its last scores.

    "near" and "far" are the PSNR of held-out views near a photo and far from all, "accepted" the
    share of the runs that have accepted the round, "spread" the standard deviation of "psnr".
    """
    out: dict[str, Any] = {}
    for method in rows[0]["methods"]:
        runs = [row["methods"][method]["rounds"] for row in rows]
        rounds = []
        for number in range(max(len(run) for run in runs)):
            done = [run[min(number, len(run) - 1)] for run in runs]
            one: dict[str, Any] = {
                name: float(np.mean([row[name] for row in done]))
                for name in COLUMNS
                if all(name in row for row in done)
            }
            for name in ("near", "far"):
                known = [row[name]["psnr"] for row in done if row[name]]
                one[name] = float(np.mean(known)) if known else None
            one["accepted"] = float(
                np.mean([len(run) > number and run[number]["accepted"] for run in runs])
            )
            one["spread"] = float(np.std([row["psnr"] for row in done]))
            rounds.append(one)
        out[method] = {"runs": len(runs), "rounds": rounds}
    return out


def _lines(report: dict[str, Any]) -> list[tuple[str, str, str, list[dict[str, Any]]]]:
    """Scene, photos, method and rounds of each line of the table."""
    return [
        (scene, photos, method, summary["rounds"])
        for scene, by_photos in report["scenes"].items()
        for photos, methods in by_photos.items()
        for method, summary in methods.items()
    ]


def write_table(path: Path, report: dict[str, Any], gains: Sequence[str]) -> None:
    """Write the table, with what rounds gained and the paper's own figures under it.

    Args:
        path: of the file.
        report: what ``study.json`` holds.
        gains: lines of ``igsr_lab.study.loop_gains.gains_table``.

    Raises:
        IgsrError: the file cannot be written.
    """
    lines = [
        f"# {report['title']}",
        "",
        f"igsr {report['igsr']}; {report['protocol']['seeds']} seed(s); held-out views within "
        f"{report['protocol']['near']:g} degrees of a photo are near, beyond "
        f"{report['protocol']['far']:g} far.",
        "",
    ]
    lines += [*_table(_lines(report)), "", *gains]
    if report.get("paper"):
        lines += ["", "The paper's own (PSNR / SSIM / LPIPS, 5 000 iterations, DUSt3R poses):", ""]
        lines += [f"* {row}" for row in report["paper"]]
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _table(groups: list[tuple[str, str, str, list[dict[str, Any]]]]) -> list[str]:
    shown = [name for name in COLUMNS if name in groups[0][3][0]]
    heads = [COLUMNS[name][0] for name in shown]
    out = [
        "| scene | photos | method | round | accepted | "
        + " | ".join([*heads, "near, dB", "far, dB"])
        + " |",
        "| --- | --- | --- | ---: | ---: |" + " ---: |" * (len(shown) + 2),
    ]
    for scene, photos, method, rounds in groups:
        for number, row in enumerate(rounds):
            cells = [format(row[name], COLUMNS[name][1]) for name in shown]
            cells += ["-" if row[name] is None else f"{row[name]:.2f}" for name in ("near", "far")]
            accepted = "" if number == 0 else f"{100.0 * row['accepted']:.0f} %"
            out.append(
                f"| {scene} | {photos} | {method} | {number} | {accepted} | {' | '.join(cells)} |"
            )
    return out


def plot_rounds(path: Path, report: dict[str, Any]) -> None:
    """PSNR of the held-out views over the rounds, one panel for each scene and choice of photos.

    Raises:
        IgsrError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    groups = _lines(report)
    panels = list(dict.fromkeys((scene, photos) for scene, photos, _, _ in groups))
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.6 * columns + 0.4, 3.0 * rows + 0.3), layout="constrained")
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
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)


def write_run_sheet(out: Path, spec: RunSpec, methods: Sequence[Method]) -> None:
    """A held-out view after each round, and the two views of the largest gain in the first round.

    Raises:
        IgsrError: the file cannot be written.
    """
    folder = out / "rounds" / spec.name
    truth, first = _picture(folder / "truth.png"), _picture(folder / "first.png")
    if truth is None or first is None:
        warnings.warn(f"{folder} has no pictures: no sheet of {spec.name} is drawn.", stacklevel=4)
        return
    sheet = {}
    for method in methods:
        row = {"truth": truth, "round 0": first}
        shown = first
        for number in range(1, max(one.rounds for one in methods) + 1):
            after = _picture(folder / method.name / f"round{number}.png")
            shown = shown if after is None else after
            row[f"round {number}"] = shown
        for k in range(min(2, max(one.views for one in methods))):
            added = _picture(folder / method.name / "rounds" / "1" / f"view-{k}.after.png")
            row[f"added view {k + 1}"] = np.full_like(truth, 255) if added is None else added
        sheet[method.name] = row
    write_sheet(out / f"{spec.scene}-{spec.layout}{spec.photos}.png", sheet)


def _picture(path: Path) -> npt.NDArray[np.uint8] | None:
    if not path.is_file():
        return None
    with Image.open(path) as picture:
        return np.asarray(picture)
