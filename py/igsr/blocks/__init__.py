"""Scenes past one machine's memory: fitted in blocks, one after another or over a Ray cluster.

``fit_in_blocks`` does what ``igsr fit --blocks`` does: a coarse fit of everything, cells on the
ground plane with equally many cameras each, a fit of each cell's splats to the photos that show
them, and the joined scene with its report. Method: Lin et al., "VastGaussian" (2024).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr.blocks.options import BlockOptions
    from igsr.blocks.run import fit_in_blocks

__all__ = ["BlockOptions", "fit_in_blocks"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {"igsr.blocks.options": ("BlockOptions",), "igsr.blocks.run": ("fit_in_blocks",)},
    )
