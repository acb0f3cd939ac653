"""Scene pages in notebooks."""

from __future__ import annotations

import html
from collections.abc import Sequence

from igsr.capture import Capture
from igsr.errors import IgsrError
from igsr.rendering.scene_page import PageCamera, PageModel, scene_page
from igsr.splats import Splats


class NotebookPage:
    """A viewer for notebooks: the page's HTML in a frame of ``height`` pixels."""

    def __init__(self, page: str, height: int) -> None:
        self._page, self._height = page, height

    def __repr__(self) -> str:
        return f"NotebookPage({len(self._page)} bytes, {self._height} pixels high)"

    def _repr_html_(self) -> str:
        return framed(self._page, self._height)


def framed(page: str, height: int) -> str:
    """Return HTML of a frame of full width and ``height`` pixels with ``page``."""
    return (
        f'<iframe srcdoc="{html.escape(page)}" '
        f'style="width:100%;height:{height}px;border:0"></iframe>'
    )


def notebook_page(
    splats: Splats | Sequence[PageModel],
    capture: Capture | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    height: int = 480,
) -> NotebookPage:
    """Make the result of ``Splats.show`` and ``Refined.show``."""
    if height < 1:
        raise IgsrError(f"height must be at least 1 pixel, not {height}")
    views = [] if capture is None else capture.views
    cameras = [PageCamera(view.name, view.camera) for view in views]
    return NotebookPage(scene_page(splats, cameras, background, compares=True)[0], height)
