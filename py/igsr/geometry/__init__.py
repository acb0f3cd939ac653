"""Geometry of cameras: similarity transforms, pose errors, camera paths."""

from __future__ import annotations

from igsr.geometry.camera_paths import cameras_around, orbit
from igsr.geometry.pose_errors import pose_accuracy, pose_errors, rotation_angle
from igsr.geometry.similarity import Similarity, similarity_between

__all__ = [
    "Similarity",
    "cameras_around",
    "orbit",
    "pose_accuracy",
    "pose_errors",
    "rotation_angle",
    "similarity_between",
]
