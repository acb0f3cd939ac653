"""The files of a scene: ``scene.ply``, ``cameras.json`` and ``scene.html``."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Sequence

from igsr._internal.user_warning import warn_user
from igsr.capture import Capture
from igsr.capture.write_transforms import write_cameras
from igsr.errors import IgsrError
from igsr.rendering.scene_page import PageCamera, PageModel, compared, write_scene_page
from igsr.run import SCENE_WRITTEN, Run
from igsr.splats import Splats

logger = logging.getLogger(__name__)

SCENE = "scene.ply"
PAGE = "scene.html"


def write_scene(
    run: Run,
    splats: Splats,
    capture: Capture,
    background: Sequence[float],
    models: Sequence[PageModel] = (),
) -> None:
    """Write the scene into the run's folder.

    Args:
        run: with a folder.
        splats: the scene.
        capture: the photos that it was fitted to.
        background: RGB in [0, 1] behind the splats.
        models: models that the page compares; empty for ``splats`` alone.

    Raises:
        IgsrError: a file cannot be written.
        UserWarning: the page cannot hold the scene; the other files are written.
    """
    assert run.out is not None
    splats.save(run.out / SCENE)
    write_cameras(run.out / "cameras.json", capture.train_views)
    cameras = [PageCamera(view.name, view.camera) for view in capture.train_views]
    shown = compared(models) if models else splats
    title = run.out.resolve().name or "scene"
    try:
        notes = write_scene_page(run.out / PAGE, shown, cameras, background, title)
    except IgsrError as error:
        warn_user(f"{PAGE} is not written: {error}")
        with contextlib.suppress(OSError):
            (run.out / PAGE).unlink()  # of an earlier run
    else:
        for note in notes:
            logger.info("%s: %s", PAGE, note)
    run.wrote(SCENE_WRITTEN, run.out / SCENE)
