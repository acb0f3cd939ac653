"""Initialization of splats: SfM points, visual hull, plane sweep, SIFT features or random."""

from __future__ import annotations

from igsr.fitting.initialization.initial_splats import STARTS, initial_splats

__all__ = ["STARTS", "initial_splats"]
