"""Captures: photos, masks, cameras and points, from the formats that carry them.

One call, ``load_capture``, reads them all. Whatever the format, what comes out is the same: pinhole
cameras in OpenCV axes, photos with lens distortion undone, masks of the pixels that may be used.
"""

from __future__ import annotations

from igsr.capture.load import load_capture
from igsr.capture.types import Camera, Capture, Points, View

__all__ = ["Camera", "Capture", "Points", "View", "load_capture"]
