"""Synthetic captures: random scenes rendered with exact cameras, depth and masks."""

from igsr_lab.synth.captures import CaptureSettings, synthesize

__all__ = ["CaptureSettings", "synthesize"]
