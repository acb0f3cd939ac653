"""Fewer splats for the same pictures: prune by what they show, refine, and measure the loss."""

from .contribution import Contribution, contribution
from .plot import write_plot
from .search import DEFAULT_STEPS, Compaction, CompactProgress, compact

__all__ = [
    "DEFAULT_STEPS",
    "CompactProgress",
    "Compaction",
    "Contribution",
    "compact",
    "contribution",
    "write_plot",
]
