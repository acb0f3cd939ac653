"""Iterative refinement: fit, render novel views, denoise, select, cross-validate, refit."""

from __future__ import annotations

from igsr.refinement.loop import refine, round_denoiser
from igsr.refinement.results import Refined, RefineProgress, Round

__all__ = ["RefineProgress", "Refined", "Round", "refine", "round_denoiser"]
