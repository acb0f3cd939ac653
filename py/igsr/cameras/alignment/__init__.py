"""Global alignment: cameras and depths of all photos from pointmaps of pairs of photos."""

from __future__ import annotations

from igsr.cameras.alignment.global_alignment import Alignment, align
from igsr.cameras.alignment.predictions import PairPrediction, PhotoToAlign, Predictor
from igsr.cameras.depth_maps import AlignedPhoto

__all__ = ["AlignedPhoto", "Alignment", "PairPrediction", "PhotoToAlign", "Predictor", "align"]
