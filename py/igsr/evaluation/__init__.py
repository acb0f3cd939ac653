"""Evaluation: score splats on held-out photos; metrics and contact sheets."""

from __future__ import annotations

from igsr._internal import moved_modules
from igsr.evaluation.scores import METRICS, ScoredView, Scores, evaluate, score_views

__all__ = ["METRICS", "ScoredView", "Scores", "evaluate", "score_views"]

__getattr__ = moved_modules.moved_names(
    __name__,
    {
        "igsr.evaluation.scores": (
            *("BLACK", "WHITE", "check_masks", "default_background", "default_split"),
            *("known_background", "over_background", "views_of_split"),
        )
    },
)
