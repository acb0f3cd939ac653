"""Splats to pictures: ``render`` for numpy, ``rasterization`` for torch, videos."""

from __future__ import annotations

from igsr.rendering.renders import Render, render

__all__ = ["Render", "render"]
