"""Rendering: ``render`` for numpy, ``rasterization`` for torch, normals, videos."""

from __future__ import annotations

from igsr._internal import moved_modules
from igsr.rendering.renders import Render, render

__all__ = ["Render", "render"]

__getattr__ = moved_modules.moved_names(
    __name__, {"igsr.rendering.renders": ("intrinsics_of", "project", "viewmat_about")}
)
