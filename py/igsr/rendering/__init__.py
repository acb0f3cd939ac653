"""Rendering: ``render`` for numpy, ``rasterization`` for torch, scene pages and videos."""

from igsr.rendering.renders import Render, render

__all__ = ["Render", "render"]
