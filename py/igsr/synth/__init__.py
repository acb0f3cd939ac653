"""Procedural captures: random scenes rendered with exact cameras, depth and masks."""

from igsr.synth.captures import RECIPE_VERSION, CaptureSettings, synthesize

__all__ = ["RECIPE_VERSION", "CaptureSettings", "synthesize"]
