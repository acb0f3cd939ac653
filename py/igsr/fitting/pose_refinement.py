"""Test-time pose refinement: cameras are fitted to their photos while the splats stay as they are.

Splats and cameras that were optimized together may be rotated, moved and scaled as a whole without
any photo showing it. Scores of held-out photos therefore say which cameras they are of:

* raw: as they were given;
* aligned: moved by the similarity that maps the true train cameras onto the optimized ones;
* refined: each fitted to its own photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.event import Event, Listener
from igsr.capture import View
from igsr.errors import IgsrError
from igsr.fitting.fitter import fitted_cameras, fitter_of
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]

#: Steps that refining spends on each camera.
REFINE_STEPS = 30


def refine_cameras(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    *,
    steps: int = REFINE_STEPS,
    backend: str = "auto",
    progress: Listener | None = None,
) -> list[View]:
    """The views with poses fitted to their photos; splats and focal lengths stay as they are.

    Each view is used alone, with its photo, mask and given camera, and nothing is learned about the
    scene: this is how few-view papers score scenes whose cameras were optimized too.

    Args:
        splats: the scene.
        views: whose cameras to refine, from where they are.
        background: RGB in [0, 1] behind splats and photos with alpha.
        steps: steps per view; each moves the picture by at most about a third of a pixel, at the
            end by a hundredth.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu" or "gpu".
        progress: called with each ``igsr.Event``.

    Returns:
        The views in their order, with other cameras.

    Raises:
        IgsrError: ``steps`` is not positive, the splats are antialiased, or a view cannot be used.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if steps < 1:
        raise IgsrError(f"steps must be at least 1, not {steps}.")
    if splats.antialiased:
        raise IgsrError("Cameras cannot be refined to antialiased splats: fits draw without that.")
    if not views:
        return []
    total = steps * len(views)
    apart = ("origin", "antialiased")
    state = {name: value for name, value in vars(splats).items() if name not in apart}
    settings = {
        "steps": total,
        "sh_degree": splats.sh_degree,
        "density": "fixed",
        "background": [float(channel) for channel in background],
        "poses": "joint",
        "frozen": True,
        "camera_warm_up": 0.0,
    }
    try:
        fitter = fitter_of(views, splats.origin, state, settings, _core.resolve_backend(backend))
        for done in range(len(views), total + 1, len(views)):
            fitter.step(len(views))
            if progress is not None:
                progress(Event("refine cameras", done, total))
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    cameras = fitted_cameras(views, fitter, splats.origin)
    return [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]
