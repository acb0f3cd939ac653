"""Contact sheets: photos, renders and errors of a few views in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from igsr._internal.atomic_write import atomic_write
from igsr.evaluation.metrics import flip_map
from igsr.evaluation.scores import ScoredView

#: Most views on a contact sheet.
MAX_SHEET_VIEWS = 8
#: An absolute error of this size (of 1) is drawn white, so that small errors show.
ERROR_WHITE = 0.25
#: Longest side of one picture on the sheet, pixels.
PANEL_SIDE = 360
LABEL_HEIGHT = 24
GAP = 6
PAPER = (18, 18, 20)
INK = (235, 235, 235)


def sheet_names(names: Sequence[str]) -> set[str]:
    """The evenly spaced names that a contact sheet shows."""
    if len(names) <= MAX_SHEET_VIEWS:
        return set(names)
    indices = np.linspace(0, len(names) - 1, MAX_SHEET_VIEWS).round().astype(int)
    return {names[i] for i in indices}


def error_picture(scored: ScoredView) -> npt.NDArray[np.uint8]:
    """Absolute error averaged over the channels in false colour, uint8 [H, W, 3].

    Black is no error, white is ``ERROR_WHITE`` or more (matplotlib's "inferno"); pixels outside
    the mask, which do not count, are grey.
    """
    from matplotlib import colormaps

    difference = np.abs(scored.render.astype(np.float32) - scored.photo).mean(axis=2) / 255.0
    shade = np.clip(difference / ERROR_WHITE, 0.0, 1.0)
    picture = np.asarray(colormaps["inferno"](shade, bytes=True))[..., :3].copy()
    if scored.mask is not None:
        picture[~scored.mask] = 96
    return picture


def contact_sheet(views: Sequence[ScoredView]) -> Image.Image:
    """Photo, render and error of each view side by side, labelled with its name and PSNR."""
    return _sheet(
        [
            [
                (one.photo, one.name),
                (one.render, f"render  {one.scores['psnr']:.2f} dB"),
                (error_picture(one), f"error  (white: {ERROR_WHITE:g} and more)"),
            ]
            for one in views
        ]
    )


def flip_picture(scored: ScoredView) -> npt.NDArray[np.uint8]:
    """FLIP error of each pixel in false colour, uint8 [H, W, 3].

    Black is no error, the lightest yellow 1 (matplotlib's "magma", as FLIP's authors show it);
    pixels outside the mask, which do not count, are grey.
    """
    from matplotlib import colormaps

    errors = flip_map(scored.render, scored.photo, scored.mask)
    picture = np.asarray(colormaps["magma"](np.clip(errors, 0.0, 1.0), bytes=True))[..., :3].copy()
    if scored.mask is not None:
        picture[~scored.mask] = 96
    return picture


def flip_sheet(views: Sequence[ScoredView], side: int = PANEL_SIDE) -> Image.Image:
    """Photo, render and FLIP error of each view side by side, a row for each.

    Args:
        views: at least one.
        side: longest side of a picture on the sheet, pixels.
    """
    return _sheet(
        [
            [
                (one.photo, one.name),
                (one.render, f"render  {one.scores['psnr']:.2f} dB"),
                (flip_picture(one), f"FLIP {one.scores['flip']:.4f}"),
            ]
            for one in views
        ],
        columns=1,
        side=side,
    )


def rounds_sheet(before: Sequence[ScoredView], after: Sequence[ScoredView]) -> Image.Image:
    """Photo, render of the first fit and render after the last round, of each view."""
    return _sheet(
        [
            [
                (one.photo, one.name),
                (one.render, f"before  {one.scores['psnr']:.2f} dB"),
                (other.render, f"after  {other.scores['psnr']:.2f} dB"),
            ]
            for one, other in zip(before, after, strict=True)
        ]
    )


def _sheet(
    rows_of_panels: Sequence[Sequence[tuple[npt.NDArray[np.uint8], str]]],
    columns: int | None = None,
    side: int = PANEL_SIDE,
) -> Image.Image:
    """Pictures of each view side by side, each under its label."""
    if not rows_of_panels:
        raise ValueError("views: a contact sheet needs at least one")
    if columns is None:
        # One column of triples grows too tall to look at from about three views on.
        columns = 1 if len(rows_of_panels) <= 3 else 2
    blocks = [_block(panels, side) for panels in rows_of_panels]
    column_width = max(block.width for block in blocks)
    rows = [blocks[i : i + columns] for i in range(0, len(blocks), columns)]
    row_heights = [max(block.height for block in row) for row in rows]
    width = columns * column_width + (columns + 1) * 2 * GAP
    sheet = Image.new("RGB", (width, sum(row_heights) + (len(rows) + 1) * 2 * GAP), PAPER)
    top = 2 * GAP
    for row, height in zip(rows, row_heights, strict=True):
        for column, block in enumerate(row):
            sheet.paste(block, (2 * GAP + column * (column_width + 2 * GAP), top))
        top += height + 2 * GAP
    return sheet


def save_sheet(path: Path, sheet: Image.Image) -> None:
    """Write a contact sheet as PNG, whole or not at all.

    Raises:
        IgsrError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        sheet.save(temporary, format="PNG", optimize=True)


def _block(panels: Sequence[tuple[npt.NDArray[np.uint8], str]], side: int) -> Image.Image:
    """The pictures of one view, of one size, with a line of text above each."""
    height, width = panels[0][0].shape[:2]
    shrink = min(1.0, side / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    font = ImageFont.load_default(size=14)
    # A thumbnail of 16 pixels still needs room for its label.
    panel_width = max(size[0], 190)
    count = len(panels)
    full = count * panel_width + (count - 1) * GAP
    block = Image.new("RGB", (full, LABEL_HEIGHT + size[1]), PAPER)
    draw = ImageDraw.Draw(block)
    for index, (picture, label) in enumerate(panels):
        left = index * (panel_width + GAP)
        draw.text((left, 2), _shortened(label, font, panel_width), fill=INK, font=font)
        small = Image.fromarray(picture).resize(size, Image.Resampling.BOX)
        block.paste(small, (left, LABEL_HEIGHT))
    return block


def _shortened(text: str, font: Any, width: int) -> str:
    """The text, or its end behind an ellipsis: the end of a path is what tells views apart."""
    if font.getlength(text) <= width:
        return text
    while len(text) > 1 and font.getlength("…" + text) > width:
        text = text[1:]
    return "…" + text
