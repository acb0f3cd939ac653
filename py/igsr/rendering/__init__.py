"""Rendering: ``render`` for numpy, ``rasterization`` for torch, normals, videos."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports
from igsr.rendering.renders import Render, render

__all__ = ["Render", "render"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {},
    )
