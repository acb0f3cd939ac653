"""Splats from posed photos: settings, initialization, the fit, checkpoints, camera refinement."""

from __future__ import annotations

from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.presets import PRESETS, preset_settings
from igsr.fitting.run import Progress, fit, fit_with_cameras

__all__ = ["PRESETS", "Progress", "fit", "fit_with_cameras", "preset_settings", "refine_cameras"]
