"""Test-time pose refinement: cameras of held-out photos are fitted to them, with fixed splats.

Jointly optimized splats and cameras are determined only up to a similarity, so held-out photos are
scored with their cameras as given ("raw"), moved by the similarity from the true to the optimized
train cameras ("aligned"), or fitted to the photo ("refined").
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
from igsr.geometry.frame import Frame
from igsr.splats import PARAMETERS, Splats

Float64 = npt.NDArray[np.float64]

#: Steps per camera.
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
    """Return the views with poses fitted to their photos; splats and focal lengths stay fixed.

    Few-view papers score scenes with optimized cameras in this way.

    Args:
        splats: the scene.
        views: with initial cameras.
        background: RGB in [0, 1] behind splats and photos with alpha.
        steps: steps per view; each moves the image by about a third of a pixel at first and by a
            hundredth at the end.
        backend: "auto", "cpu" or "gpu".
        progress: called with each ``igsr.Event``.

    Returns:
        The views in their order.

    Raises:
        IgsrError: ``steps`` is not positive, the splats are antialiased, or a view cannot be used.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if steps < 1:
        raise IgsrError(f"steps must be at least 1, not {steps}.")
    if splats.antialiased:
        raise IgsrError(
            "Cameras cannot be refined with antialiased splats, which igsr does not fit."
        )
    if not views:
        return []
    frame = Frame.of_splats(splats)
    splats, inside = frame.splats(splats), [frame.view(view) for view in views]
    total = steps * len(views)
    state = {name: getattr(splats, name) for name in PARAMETERS}
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
        fitter = fitter_of(inside, splats.origin, state, settings, _core.resolve_backend(backend))
        for done in range(len(views), total + 1, len(views)):
            fitter.step(len(views))
            if progress is not None:
                progress(Event("refine cameras", done, total))
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    cameras = fitted_cameras(inside, fitter, splats.origin)
    return [
        replace(view, camera=frame.inverse.camera(camera))
        for view, camera in zip(views, cameras, strict=True)
    ]
