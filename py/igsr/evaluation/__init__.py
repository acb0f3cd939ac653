"""Scores of splats on the photos of a capture: metrics, held-out scores, contact sheets."""

from __future__ import annotations

from igsr.evaluation.scores import METRICS, ScoredView, Scores, evaluate, score_views

__all__ = ["METRICS", "ScoredView", "Scores", "evaluate", "score_views"]
