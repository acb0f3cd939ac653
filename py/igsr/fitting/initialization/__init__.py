"""The splats that a fit starts from: SfM points, the visual hull, plane sweep, SIFT, random."""

from __future__ import annotations

from igsr.fitting.initialization.initial_splats import STARTS, initial_splats

__all__ = ["STARTS", "initial_splats"]
