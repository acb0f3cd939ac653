"""Iterative refinement: fit, cross-validate, render novel views, denoise, select, refit.

Names are imported when they are first used: the settings alone load neither torch nor the renderer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr.refinement.loop import refine, round_denoiser
    from igsr.refinement.results import Refined, RefineProgress, Round, Stop, StopReason
    from igsr.refinement.settings import RefineSettings

__all__ = [
    "RefineProgress",
    "RefineSettings",
    "Refined",
    "Round",
    "Stop",
    "StopReason",
    "refine",
    "round_denoiser",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "igsr.refinement.loop": ("refine", "round_denoiser"),
            "igsr.refinement.results": (
                *("RefineProgress", "Refined", "Round", "Stop", "StopReason"),
            ),
            "igsr.refinement.settings": ("RefineSettings",),
        },
    )
