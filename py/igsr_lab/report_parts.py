"""Parts of reports: Markdown tables, matplotlib figures and sheets of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Width of a picture on a sheet.
PICTURE_WIDTH_INCHES = 2.6


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[object]], left: int) -> list[str]:
    """Return the lines of a table; the first ``left`` columns are left-aligned."""
    rule = [*["---"] * left, *["---:"] * (len(heads) - left)]
    return [f"| {' | '.join(map(str, cells))} |" for cells in (heads, rule, *rows)]


def cell(value: float | None, form: str) -> str:
    """Format a number; None is "-"."""
    return "-" if value is None else format(value, form)


def new_figure(width: float, height: float) -> Figure:
    """A figure of a size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path, dpi: int = 120) -> None:
    """Write a figure."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi)


def draw_psnr(axis: Any, groups: Mapping[str, Mapping[str, Sequence[Mapping[str, Any]]]]) -> None:
    """Draw the PSNR of fits by group and preset, with means; "train_psnr" is hollow."""
    for g, by_preset in enumerate(groups.values()):
        for k, (preset, rows) in enumerate(by_preset.items()):
            at = [g + 0.5 * (k + 0.5) / len(by_preset) - 0.25] * len(rows)
            psnrs, color = [row["psnr"] for row in rows], f"C{k}"
            label = preset if g == 0 else None
            axis.plot(at, psnrs, "o", color=color, alpha=0.6, label=label)
            axis.plot(at[0], np.mean(psnrs), "_", color=color, markersize=16, markeredgewidth=2)
            trained = [row["train_psnr"] for row in rows if "train_psnr" in row]
            if trained:
                label = f"{preset}, fitted photos" if g == 0 else None
                axis.plot(at, trained, "^", color=color, markerfacecolor="none", label=label)
    axis.set_ylabel("PSNR of held-out views, dB")
    axis.legend(fontsize=8)


def label_groups(axis: Any, labels: Iterable[str]) -> None:
    """Label groups at 0, 1, ... on the x axis."""
    names = list(labels)
    axis.set_xticks(range(len(names)), names, fontsize=8, rotation=20, ha="right")
    axis.set_xlim(-0.5, len(names) - 0.5)
    axis.grid(alpha=0.3, axis="y")


def write_sheet(path: Path, rows: Mapping[str, Mapping[str, npt.NDArray[np.uint8]]]) -> None:
    """Write pictures, uint8 [H, W, 3], in labeled rows and columns."""
    first = next(iter(rows.values()))
    height, width = next(iter(first.values())).shape[:2]
    row_inches = PICTURE_WIDTH_INCHES * height / width + 0.05
    figure = new_figure(PICTURE_WIDTH_INCHES * len(first), row_inches * len(rows) + 0.2)
    axes = figure.subplots(len(rows), len(first), squeeze=False)
    for line, (label, pictures) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(label, fontsize=8)
        for axis, picture in zip(line, pictures.values(), strict=True):
            axis.imshow(picture)
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, column in zip(axes[0], first, strict=True):
        axis.set_title(column, fontsize=8)
    save_figure(figure, path)
