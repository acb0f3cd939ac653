"""Splats from photos: settings, initialization, the fit, its checkpoint and its report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr.fitting.fit_capture import fit_capture
    from igsr.fitting.fit_photos import fit
    from igsr.fitting.pose_refinement import refine_cameras
    from igsr.fitting.presets import settings_for
    from igsr.fitting.result import FitResult
    from igsr.fitting.settings import FitSettings

__all__ = ["FitResult", "FitSettings", "fit", "fit_capture", "refine_cameras", "settings_for"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "igsr.fitting.fit_photos": ("fit",),
            "igsr.fitting.fit_capture": ("fit_capture",),
            "igsr.fitting.pose_refinement": ("refine_cameras",),
            "igsr.fitting.presets": ("settings_for",),
            "igsr.fitting.result": ("FitResult",),
            "igsr.fitting.settings": ("FitSettings",),
        },
    )
