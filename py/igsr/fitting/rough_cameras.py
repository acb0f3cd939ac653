"""Cameras from coarse to fine: a joint fit first finds them in photos of half the size.

Splats that have settled around wrong cameras keep them there: it is better to find the cameras
roughly and to start again.
"""

from __future__ import annotations

from dataclasses import replace

from igsr.capture import Capture
from igsr.capture.downscaling import halved
from igsr.errors import IgsrError
from igsr.fitting.exposures import StartingExposures
from igsr.fitting.fitter import (
    fitted_cameras,
    fitter_of,
    initial_state,
    with_train_cameras,
    without_exposures,
)
from igsr.fitting.pose_priors import PosePriors
from igsr.fitting.run import FitRun, Progress, Report
from igsr.fitting.settings import FitSettings

#: Fractions of the fit's steps and splats that the rough fit has.
STEPS, SPLATS = 0.375, 0.25
#: Photos whose smaller side would be shorter than so many pixels are not halved.
SMALLEST_SIDE = 64


def with_rough_cameras(
    capture: Capture,
    settings: FitSettings,
    backend: dict[str, str],
    priors: PosePriors | None,
    report: Report | None,
    exposures: StartingExposures | None = None,
) -> tuple[Capture, bool]:
    """The capture with train cameras as the rough fit has them, and whether ``report`` ended it.

    The capture is as it was where there is nothing to find, or photos are too small for it.

    Args:
        capture: its train views are fitted.
        settings: of the fit that follows.
        backend: "backend" is the resolved one.
        priors: pose priors of the train views, if there are any.
        report: called with step 0 of the fit that follows.
        exposures: where those of the train views start, if they are optimized.
    """
    if len(capture.train_views) == 1 and settings.focal == "fixed":
        return capture, False  # a camera alone stays where it is
    views = [halved(view) for view in capture.train_views]
    if min(min(view.camera.width, view.camera.height) for view in views) < SMALLEST_SIDE:
        return capture, False
    small = Capture(capture.path, views, capture.points)
    rough = replace(
        settings,
        steps=max(1, round(STEPS * settings.steps)),
        max_splats=max(1, round(SPLATS * settings.max_splats)),
    )
    stopped = False

    def report_rough(now: Progress) -> bool:
        # The fit itself has not begun: whoever stops it now stops it before its first step.
        nonlocal stopped
        now = replace(now, step=0, steps=settings.steps)
        stopped = report is not None and report(now) is False
        return not stopped

    try:
        alike = small
        if exposures is not None:
            alike = replace(small, views=without_exposures(views, exposures.exposures))
        state, started = initial_state(alike, rough)
        origin = state.pop("origin")
        if priors is not None:
            # What is known of rotations, moves and focal lengths' logarithms holds for any size.
            priors = replace(priors, views=views)
        fitter = fitter_of(
            views, origin, state, rough.plain(), backend["backend"], priors, exposures
        )
    except (IgsrError, ValueError):
        return capture, False  # what cannot be started from at half size may be at full size
    FitRun(fitter, rough, started, backend, report_rough).optimize()
    cameras = []
    for view, camera in zip(
        capture.train_views, fitted_cameras(views, fitter, origin), strict=True
    ):
        K = view.camera.K.copy()
        K[[0, 1], [0, 1]] = 2.0 * camera.K[[0, 1], [0, 1]]
        cameras.append(replace(view.camera, viewmat=camera.viewmat, K=K))
    return with_train_cameras(capture, cameras), stopped
