"""Procedural captures: random scenes rendered with exact cameras, depth and masks."""

from igsr_lab.synth.captures import (
    RECIPE_VERSION,
    CaptureSettings,
    is_made,
    scene_name,
    synthesize,
)

__all__ = ["RECIPE_VERSION", "CaptureSettings", "is_made", "scene_name", "synthesize"]
