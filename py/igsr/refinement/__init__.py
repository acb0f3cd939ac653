"""Iterative refinement: fit, render novel views, denoise, select, refit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr.refinement.refine_photos import refine, round_denoiser
    from igsr.refinement.results import Refined, Round, Stop, StopReason
    from igsr.refinement.settings import RefineSettings

__all__ = [
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
            "igsr.refinement.refine_photos": ("refine", "round_denoiser"),
            "igsr.refinement.results": ("Refined", "Round", "Stop", "StopReason"),
            "igsr.refinement.settings": ("RefineSettings",),
        },
    )
