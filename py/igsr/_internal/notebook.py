"""What a notebook shows of an object: its ``repr`` and pictures, as ``_repr_html_``.

A class gets pictures by inheriting ``NotebookPicture`` and naming the function that makes them. The
function is imported when a notebook shows the object, so that a class may lie in a room below the
renderer that draws it.
"""

from __future__ import annotations

import base64
import html
import io
import pkgutil
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]

#: Longest side of a picture, pixels.
LONGEST_SIDE = 240


class NotebookPicture:
    """Gives a class a ``_repr_html_``: its ``repr`` above its pictures, in one strip."""

    #: "module:function" of the function that takes the object and returns its pictures, a list of
    #: uint8 [H, W, 3] or [H, W, 4].
    _pictures_by: ClassVar[str]

    def _repr_html_(self) -> str:
        """HTML for notebooks; without pictures where they cannot be made."""
        try:
            pictures = pkgutil.resolve_name(self._pictures_by)(self)
        except (RuntimeError, ValueError, OSError):  # what cannot be drawn is still shown as text
            pictures = []
        return html_of(repr(self), pictures)


def html_of(title: str, pictures: Sequence[Picture]) -> str:
    """A line of text above pictures, as HTML that stands alone.

    Args:
        title: the text; it is escaped.
        pictures: uint8 [H, W, 3] or [H, W, 4]; each is reduced to at most ``LONGEST_SIDE`` pixels.

    Returns:
        HTML; the pictures are PNG data URIs.
    """
    strip = "".join(
        f'<img src="{png_data_uri(picture)}" style="margin:2px;display:inline-block">'
        for picture in pictures
    )
    return f"<div><code>{html.escape(title)}</code><br>{strip}</div>"


def png_data_uri(picture: Picture) -> str:
    """A picture, uint8 [H, W, 3] or [H, W, 4], as the data URI of a small PNG."""
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    file = io.BytesIO()
    image.save(file, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")


def numbers(values: Any) -> str:
    """A few numbers for a short ``repr``, such as "1.5, 0, -2"."""
    return ", ".join(f"{value:.4g}" for value in values)
