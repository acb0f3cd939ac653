"""From pointmaps of pairs of photos to cameras and depths of all of them in one world."""

from __future__ import annotations

from .aligned_photo import AlignedPhoto
from .alignment import Alignment, align
from .confidence import TRUSTED, trusted_pixels
from .predictions import Grid, PairPrediction, PhotoToAlign, Predictor

__all__ = [
    "TRUSTED",
    "AlignedPhoto",
    "Alignment",
    "Grid",
    "PairPrediction",
    "PhotoToAlign",
    "Predictor",
    "align",
    "trusted_pixels",
]
