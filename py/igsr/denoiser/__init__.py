"""The denoiser: removes floaters, blur and holes from renders of scenes with few photos.

``denoise`` cleans a render, and returns a confidence for each pixel. It uses the rasterizer's
buffers (``render_buffers``) and the photos, warped to the render's camera (``photo_sources``).
``igsr_lab.denoiser`` trains the weights.

Names are imported on first use (PEP 562), so that command lines do not load torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr.denoiser.buffers import Buffers, photo_support, render_buffers
    from igsr.denoiser.cleaning import Denoiser, NetworkDenoiser, denoise
    from igsr.denoiser.named import named_denoiser
    from igsr.denoiser.single_step import SingleStepDenoiser
    from igsr.denoiser.warping import Source, photo_sources
    from igsr.denoiser.weights import load_network, save_network

__all__ = [
    "Buffers",
    "Denoiser",
    "NetworkDenoiser",
    "SingleStepDenoiser",
    "Source",
    "denoise",
    "load_network",
    "named_denoiser",
    "photo_sources",
    "photo_support",
    "render_buffers",
    "save_network",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "igsr.denoiser.buffers": ("Buffers", "photo_support", "render_buffers"),
            "igsr.denoiser.cleaning": ("Denoiser", "NetworkDenoiser", "denoise"),
            "igsr.denoiser.named": ("named_denoiser",),
            "igsr.denoiser.single_step": ("SingleStepDenoiser",),
            "igsr.denoiser.warping": ("Source", "photo_sources"),
            "igsr.denoiser.weights": ("load_network", "save_network"),
        },
    )
