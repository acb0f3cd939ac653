"""Scenes larger than one machine's memory: fitted in blocks, sequentially or on a Ray cluster.

``fit_in_blocks`` is ``igsr fit --blocks``: a coarse fit of all photos, cells on the ground plane
with equal numbers of cameras, a fit of each cell to the photos that show it, and the joined scene
with its report. Method: Lin et al., "VastGaussian" (2024).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr.blocks.run import fit_in_blocks
    from igsr.blocks.tasks import BlockOptions

__all__ = ["BlockOptions", "fit_in_blocks"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {"igsr.blocks.run": ("fit_in_blocks",), "igsr.blocks.tasks": ("BlockOptions",)},
    )
