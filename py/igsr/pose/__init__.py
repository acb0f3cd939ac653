"""Pose estimation: cameras for photos that have none, by COLMAP or a pose network.

>>> import igsr
>>> capture = igsr.estimate_poses("photos")
"""

from __future__ import annotations

from igsr.pose.cache import (
    check_enough_placed,
    found_before,
    has_found,
    kept_cameras,
    kept_capture,
    not_placed,
    photos_note,
)
from igsr.pose.estimate import Estimate, Estimator, Progress
from igsr.pose.find_cameras import (
    AUTO,
    estimate,
    estimate_poses,
    find_cameras,
    photos_at,
    photos_of,
)
from igsr.pose.found_cameras import FoundCameras, read_found

__all__ = [
    "AUTO",
    "Estimate",
    "Estimator",
    "FoundCameras",
    "Progress",
    "check_enough_placed",
    "estimate",
    "estimate_poses",
    "find_cameras",
    "found_before",
    "has_found",
    "kept_cameras",
    "kept_capture",
    "not_placed",
    "photos_at",
    "photos_note",
    "photos_of",
    "read_found",
]
