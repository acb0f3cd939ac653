"""From pointmaps of pairs of photos to cameras and depths of all of them in one world."""

from __future__ import annotations

from igsr.pose.alignment.aligned_photo import AlignedPhoto
from igsr.pose.alignment.confidence import TRUSTED, trusted_pixels
from igsr.pose.alignment.global_alignment import Alignment, align
from igsr.pose.alignment.predictions import PairPrediction, PhotoToAlign, Predictor

__all__ = [
    "TRUSTED",
    "AlignedPhoto",
    "Alignment",
    "PairPrediction",
    "PhotoToAlign",
    "Predictor",
    "align",
    "trusted_pixels",
]
