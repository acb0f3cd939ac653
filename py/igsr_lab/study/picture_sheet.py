"""A sheet of pictures with names for its rows and columns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write

#: Width of a picture on the sheet, inches, at so many pixels per inch.
PICTURE_WIDTH, DPI = 2.6, 120


def write_sheet(path: Path, rows: Mapping[str, Mapping[str, npt.NDArray[np.uint8]]]) -> None:
    """Write a sheet (.png) of pictures uint8 [H, W, 3], by row and column.

    Raises:
        IgsrError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    first = next(iter(rows.values()))
    height, width = next(iter(first.values())).shape[:2]
    size = (PICTURE_WIDTH * len(first), (PICTURE_WIDTH * height / width + 0.05) * len(rows) + 0.2)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(rows), len(first), squeeze=False)
    for line, (row, pictures) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(row, fontsize=8)
        for axis, picture in zip(line, pictures.values(), strict=True):
            axis.imshow(picture)
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, column in zip(axes[0], first, strict=True):
        axis.set_title(column, fontsize=8)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)
