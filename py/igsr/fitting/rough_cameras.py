"""Rough cameras: a joint fit first finds the cameras in photos of half the size.

Splats that have settled around wrong cameras keep them wrong, so the fit then starts over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from igsr import _core
from igsr.capture import Capture
from igsr.capture.downscaling import halved
from igsr.errors import IgsrError
from igsr.fitting.fitter import fitted_cameras, fitter_of, initial_state, with_train_cameras
from igsr.fitting.inputs import FitInputs
from igsr.fitting.settings import FitSettings

#: Fraction of the fit's steps and of its maximum number of splats.
STEPS_FRACTION = 0.375
SPLATS_FRACTION = 0.25
#: Photos whose shorter side would be shorter than this are not halved, pixels.
MIN_SIDE_PX = 64


def with_rough_cameras(
    inputs: FitInputs, take_steps: Callable[[_core.Fitter, FitSettings], None]
) -> Capture:
    """Return the capture with train cameras as found at half size.

    The capture is returned unchanged if its photos are too small or cannot be initialized from.

    Args:
        inputs: of the fit.
        take_steps: takes all steps of a fitter with these settings.
    """
    capture, settings = inputs.capture, inputs.settings
    if len(capture.train_views) == 1 and settings.focal == "fixed":
        return capture  # the pose of a single camera is arbitrary
    views = [halved(view) for view in capture.train_views]
    if min(min(view.camera.width, view.camera.height) for view in views) < MIN_SIDE_PX:
        return capture
    small = Capture(capture.path, views, capture.points)
    rough = replace(
        settings,
        steps=max(1, round(STEPS_FRACTION * settings.steps)),
        max_splats=max(1, round(SPLATS_FRACTION * settings.max_splats)),
    )
    # Priors on rotations, translations and log focal lengths hold for any size.
    priors = None if inputs.priors is None else replace(inputs.priors, views=views)
    try:
        state, _ = initial_state(inputs.with_scene_colors(small), rough)
        origin = state.pop("origin")
        fitter = fitter_of(
            views, origin, state, rough.plain(), inputs.backend, priors, inputs.exposures
        )
    except (IgsrError, ValueError):
        return capture  # the full size may work where half the size does not
    take_steps(fitter, rough)
    cameras = []
    found = fitted_cameras(views, fitter, origin)
    for view, camera in zip(capture.train_views, found, strict=True):
        K = view.camera.K.copy()
        K[[0, 1], [0, 1]] = 2.0 * camera.K[[0, 1], [0, 1]]
        cameras.append(replace(view.camera, viewmat=camera.viewmat, K=K))
    return with_train_cameras(capture, cameras)
