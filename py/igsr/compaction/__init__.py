"""Compaction: prune the splats that contribute least, and fine-tune the remaining ones."""

from igsr.compaction.contribution import Contribution, contribution
from igsr.compaction.plot_curve import write_plot
from igsr.compaction.search import DEFAULT_STEPS, Compaction, compact

__all__ = [
    "DEFAULT_STEPS",
    "Compaction",
    "Contribution",
    "compact",
    "contribution",
    "write_plot",
]
