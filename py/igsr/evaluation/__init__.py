"""Evaluation: scores of splats on held-out photos, metrics, contact sheets and report pages."""

from igsr.evaluation.scores import METRICS, ScoredView, Scores, evaluate, score_views

__all__ = ["METRICS", "ScoredView", "Scores", "evaluate", "score_views"]
