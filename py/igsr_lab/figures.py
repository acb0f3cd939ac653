"""Write matplotlib figures and sheets of pictures as PNG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Width of a picture on a sheet.
PICTURE_WIDTH_INCHES = 2.6


def save_figure(figure: Figure, path: Path, dpi: int = 120) -> None:
    """Write a figure."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi)


def write_sheet(path: Path, rows: Mapping[str, Mapping[str, npt.NDArray[np.uint8]]]) -> None:
    """Write pictures, uint8 [H, W, 3], in labeled rows and columns."""
    from matplotlib.figure import Figure

    first = next(iter(rows.values()))
    height, width = next(iter(first.values())).shape[:2]
    row_inches = PICTURE_WIDTH_INCHES * height / width + 0.05
    size = (PICTURE_WIDTH_INCHES * len(first), row_inches * len(rows) + 0.2)
    figure = Figure(figsize=size, layout="constrained")
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
