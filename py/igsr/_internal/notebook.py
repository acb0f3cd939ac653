"""Images of objects in notebooks, as ``_repr_html_``.

A class inherits ``NotebookPicture`` and names the function that makes its images. It is imported
when a notebook shows the object, because it may depend on the class.
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

MAX_SIDE_PX = 240


class NotebookPicture:
    """Adds a ``_repr_html_`` that shows ``repr`` above a strip of images."""

    #: "module:function" that returns the images of an object, uint8 [H, W, 3] or [H, W, 4].
    _pictures_by: ClassVar[str]

    def _repr_html_(self) -> str:
        """Return HTML for notebooks."""
        try:
            pictures = pkgutil.resolve_name(self._pictures_by)(self)
        except (RuntimeError, ValueError, OSError):  # show the text only
            pictures = []
        return html_of(repr(self), pictures)


def html_of(title: str, pictures: Sequence[Picture]) -> str:
    """Return HTML of a line of text above images, as PNG data URIs.

    Args:
        title: the text; it is escaped.
        pictures: uint8 [H, W, 3] or [H, W, 4]; each is reduced to at most ``MAX_SIDE_PX``.
    """
    strip = "".join(
        f'<img src="{png_data_uri(picture)}" style="margin:2px;display:inline-block">'
        for picture in pictures
    )
    return f"<div><code>{html.escape(title)}</code><br>{strip}</div>"


def png_data_uri(picture: Picture) -> str:
    """Return the data URI of a small PNG of an image, uint8 [H, W, 3] or [H, W, 4]."""
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((MAX_SIDE_PX, MAX_SIDE_PX))
    file = io.BytesIO()
    image.save(file, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")


def numbers(values: Any) -> str:
    """Format a few numbers for a ``repr``, such as "1.5, 0, -2"."""
    return ", ".join(f"{value:.4g}" for value in values)
