"""Splats from posed photos: settings, initialization, the fit, checkpoints, camera refinement.

Names are imported when they are first used (PEP 562): the command line reads settings and presets
without loading what fits.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igsr.fitting.optimization import Progress
    from igsr.fitting.pose_refinement import refine_cameras
    from igsr.fitting.presets import PRESETS, preset_settings, settings_for
    from igsr.fitting.run import fit, fit_with_cameras
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

#: Where each public name is defined.
_HOME_OF = {
    "FitSettings": "settings",
    "PRESETS": "presets",
    "Progress": "optimization",
    "fit": "run",
    "fit_with_cameras": "run",
    "preset_settings": "presets",
    "refine_cameras": "pose_refinement",
    "settings_for": "presets",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'igsr.fitting' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"igsr.fitting.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value
