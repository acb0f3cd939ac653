"""Captures: read and write photos, masks, cameras and points.

``load_capture`` reads all formats and returns the same for each: pinhole cameras in OpenCV axes,
undistorted photos, and masks of the pixels that may be used.
"""

from __future__ import annotations

from igsr.capture.exposure import Exposure
from igsr.capture.load import load_capture
from igsr.capture.types import Camera, Capture, Points, PseudoView, View, photos_among

__all__ = [
    "Camera",
    "Capture",
    "Exposure",
    "Points",
    "PseudoView",
    "View",
    "load_capture",
    "photos_among",
]
