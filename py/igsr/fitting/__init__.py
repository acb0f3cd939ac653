"""Splats from posed photos: settings, initialization, the fit, checkpoints, camera refinement.

Names are imported when they are first used (PEP 562): the command line reads settings and presets
without loading what fits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr.fitting.fit_capture import fit, fit_with_cameras
    from igsr.fitting.pose_refinement import refine_cameras
    from igsr.fitting.presets import PRESETS, preset_settings, settings_for
    from igsr.fitting.run import Progress
    from igsr.fitting.settings import FitSettings

__all__ = [
    "PRESETS",
    "FitSettings",
    "Progress",
    "fit",
    "fit_with_cameras",
    "preset_settings",
    "refine_cameras",
    "settings_for",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "igsr.fitting.run": ("Progress",),
            "igsr.fitting.pose_refinement": ("refine_cameras",),
            "igsr.fitting.presets": ("PRESETS", "preset_settings", "settings_for"),
            "igsr.fitting.fit_capture": ("fit", "fit_with_cameras"),
            "igsr.fitting.settings": ("FitSettings",),
        },
    )
