"""Iterative refinement: fit, render novel views, denoise, select, cross-validate, refit.

Names are imported when they are first used: the settings alone load neither torch nor the renderer.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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

_MODULES = {
    "igsr.refinement.loop": ("refine", "round_denoiser"),
    "igsr.refinement.results": ("RefineProgress", "Refined", "Round", "Stop", "StopReason"),
    "igsr.refinement.settings": ("RefineSettings",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'igsr.refinement' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)
