"""Cameras of photos that have none: by matches and COLMAP, or by a pose network.

>>> import igsr
>>> capture = igsr.find_cameras("photos")
"""

from __future__ import annotations

from igsr.cameras.find import AUTO, CameraSettings, find_cameras
from igsr.cameras.load import LoadedPhotos, load_photos

__all__ = ["AUTO", "CameraSettings", "LoadedPhotos", "find_cameras", "load_photos"]
