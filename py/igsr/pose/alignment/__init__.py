"""From pointmaps of pairs of photos to cameras and depths of all of them in one world."""

from __future__ import annotations

from .alignment import Alignment, align
from .confidence import TRUSTED, without_floaters
from .predictions import Grid, PairPrediction, PhotoToAlign, Predictor

__all__ = [
    "TRUSTED",
    "Alignment",
    "Grid",
    "PairPrediction",
    "PhotoToAlign",
    "Predictor",
    "align",
    "without_floaters",
]
