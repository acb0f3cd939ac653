"""Evaluation: score splats on held-out photos; metrics and contact sheets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports
from igsr.evaluation.scores import METRICS, ScoredView, Scores, evaluate, score_views

__all__ = ["METRICS", "ScoredView", "Scores", "evaluate", "score_views"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {},
    )
