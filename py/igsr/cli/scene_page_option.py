"""``scene.html``, which ``igsr fit`` and ``igsr refine`` write beside ``scene.ply``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from igsr.errors import IgsrError

if TYPE_CHECKING:
    from igsr.capture import Capture
    from igsr.rendering.scene_page import PageModel
    from igsr.splats import Splats

#: The page's name in the folder of a fit or a refinement.
PAGE = "scene.html"

HtmlOption = Annotated[
    bool,
    typer.Option("--html/--no-html", help=f"Write {PAGE}, which shows the scene in a browser."),
]


def write_page(
    out: Path,
    splats: Splats | Sequence[PageModel],
    capture: Capture,
    background: Sequence[float] | None = None,
) -> bool:
    """Write ``scene.html`` with the cameras of the train views; whether it was written.

    What the page cannot hold is named in a ``UserWarning``: the fit itself stands.

    Args:
        out: the folder.
        splats: the model, or several to compare, the last of which is shown alone where there are
            too many splats.
        capture: the photos that it was fitted to.
        background: RGB in [0, 1]; None is the default of the photos.
    """
    from igsr.evaluation.scores import default_background
    from igsr.rendering.scene_page import PageCamera, compared, write_scene_page
    from igsr.splats import Splats

    models = splats if isinstance(splats, Splats) else compared(splats)
    cameras = [PageCamera(view.name, view.camera) for view in capture.train_views]
    color = default_background(capture) if background is None else background
    try:
        title = out.resolve().name or "scene"
        notes = write_scene_page(out / PAGE, models, cameras, color, title)
    except IgsrError as error:
        warnings.warn(f"{PAGE} is not written: {error}", stacklevel=2)
        return False
    for note in notes:
        warnings.warn(f"{PAGE}: {note}", stacklevel=2)
    return True
