"""Contact sheets of FLIP errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.evaluation.contact_sheet import MASKED_GRAY, panels_sheet
from igsr.evaluation.metrics import flip_errors
from igsr.evaluation.scores import ScoredView


def flip_sheet(views: Sequence[ScoredView], side: int) -> Image.Image:
    """Draw photo, render and FLIP error of each view, one view per row.

    Args:
        views: at least one.
        side: longest side of a picture on the sheet, pixels.
    """
    rows = [
        [
            (one.photo, one.name),
            (one.render, f"render  {one.scores['psnr']:.2f} dB"),
            (_flip_picture(one), f"FLIP {one.scores['flip']:.4f}"),
        ]
        for one in views
    ]
    return panels_sheet(rows, columns=1, side=side)


def _flip_picture(scored: ScoredView) -> npt.NDArray[np.uint8]:
    """FLIP errors in false color, as FLIP's authors show them; masked pixels are gray."""
    from matplotlib import colormaps

    render, photo = scored.render, scored.photo
    if scored.mask is not None:
        render, photo = (picture * scored.mask[..., None] for picture in (render, photo))
    errors, _ = flip_errors(render, photo)
    picture = np.asarray(colormaps["magma"](np.clip(errors, 0.0, 1.0), bytes=True))[..., :3].copy()
    if scored.mask is not None:
        picture[~scored.mask] = MASKED_GRAY
    return picture
