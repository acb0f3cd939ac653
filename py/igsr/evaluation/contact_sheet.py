"""Contact sheets: photos, renders and errors of a few views in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from igsr._internal.atomic_write import atomic_write
from igsr.evaluation.scores import ScoredView

#: Maximum number of views on a contact sheet.
MAX_SHEET_VIEWS = 8
#: Absolute errors of at least this, of 1, are white, so that small errors are visible.
ERROR_WHITE = 0.25
#: Longest side of one picture on the sheet.
PANEL_SIDE_PX = 360
#: Minimum width of one picture with its label.
MIN_PANEL_WIDTH_PX = 190
LABEL_HEIGHT_PX = 24
GAP_PX = 6
PAPER = (18, 18, 20)
INK = (235, 235, 235)
#: Gray of masked pixels in pictures of errors.
MASKED_GRAY = 96


def sheet_names(names: Sequence[str]) -> set[str]:
    """Choose evenly spaced names for a contact sheet."""
    if len(names) <= MAX_SHEET_VIEWS:
        return set(names)
    indices = np.linspace(0, len(names) - 1, MAX_SHEET_VIEWS).round().astype(int)
    return {names[i] for i in indices}


def error_picture(scored: ScoredView) -> npt.NDArray[np.uint8]:
    """Draw the absolute error, mean over channels, in false color; masked pixels are gray."""
    from matplotlib import colormaps

    difference = np.abs(scored.render.astype(np.float32) - scored.photo).mean(axis=2) / 255.0
    shade = np.clip(difference / ERROR_WHITE, 0.0, 1.0)
    picture = np.asarray(colormaps["inferno"](shade, bytes=True))[..., :3].copy()
    if scored.mask is not None:
        picture[~scored.mask] = MASKED_GRAY
    return picture


def contact_sheet(views: Sequence[ScoredView]) -> Image.Image:
    """Draw photo, render and error of each view, labeled with its name and PSNR."""
    return panels_sheet(
        [
            [
                (one.photo, one.name),
                (one.render, f"render  {one.scores['psnr']:.2f} dB"),
                (error_picture(one), f"error  (white: {ERROR_WHITE:g} and more)"),
            ]
            for one in views
        ]
    )


def rounds_sheet(before: Sequence[ScoredView], after: Sequence[ScoredView]) -> Image.Image:
    """Draw each photo with its render after the first fit and after the last round."""
    return panels_sheet(
        [
            [
                (one.photo, one.name),
                (one.render, f"before  {one.scores['psnr']:.2f} dB"),
                (other.render, f"after  {other.scores['psnr']:.2f} dB"),
            ]
            for one, other in zip(before, after, strict=True)
        ]
    )


def panels_sheet(
    rows_of_panels: Sequence[Sequence[tuple[npt.NDArray[np.uint8], str]]],
    columns: int | None = None,
    side: int = PANEL_SIDE_PX,
) -> Image.Image:
    """Draw rows of labeled pictures, each picture at most ``side`` pixels long, in columns."""
    if not rows_of_panels:
        raise ValueError("views: a contact sheet needs at least one")
    if columns is None:
        # A single column of many views would be too tall.
        columns = 1 if len(rows_of_panels) <= 3 else 2
    blocks = [_block(panels, side) for panels in rows_of_panels]
    column_width = max(block.width for block in blocks)
    rows = [blocks[i : i + columns] for i in range(0, len(blocks), columns)]
    row_heights = [max(block.height for block in row) for row in rows]
    width = columns * column_width + (columns + 1) * 2 * GAP_PX
    sheet = Image.new("RGB", (width, sum(row_heights) + (len(rows) + 1) * 2 * GAP_PX), PAPER)
    top = 2 * GAP_PX
    for row, height in zip(rows, row_heights, strict=True):
        for column, block in enumerate(row):
            sheet.paste(block, (2 * GAP_PX + column * (column_width + 2 * GAP_PX), top))
        top += height + 2 * GAP_PX
    return sheet


def save_sheet(path: Path, sheet: Image.Image) -> None:
    """Write a contact sheet as PNG."""
    with atomic_write(path) as temporary:
        sheet.save(temporary, format="PNG", optimize=True)


def _block(panels: Sequence[tuple[npt.NDArray[np.uint8], str]], side: int) -> Image.Image:
    """Pictures of one view side by side, each under its label."""
    height, width = panels[0][0].shape[:2]
    shrink = min(1.0, side / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    font = ImageFont.load_default(size=14)
    panel_width = max(size[0], MIN_PANEL_WIDTH_PX)
    block_width = len(panels) * (panel_width + GAP_PX) - GAP_PX
    block = Image.new("RGB", (block_width, LABEL_HEIGHT_PX + size[1]), PAPER)
    draw = ImageDraw.Draw(block)
    for index, (picture, label) in enumerate(panels):
        left = index * (panel_width + GAP_PX)
        draw.text((left, 2), _shortened(label, font, panel_width), fill=INK, font=font)
        small = Image.fromarray(picture).resize(size, Image.Resampling.BOX)
        block.paste(small, (left, LABEL_HEIGHT_PX))
    return block


def _shortened(text: str, font: Any, width: int) -> str:
    """The text, or its end after an ellipsis, since paths differ at the end."""
    if font.getlength(text) <= width:
        return text
    while len(text) > 1 and font.getlength("…" + text) > width:
        text = text[1:]
    return "…" + text
