"""The denoiser: cleans renders of poorly known scenes, and says where the result may be trusted."""

from __future__ import annotations

from .buffers import Buffers, photo_support, render_buffers
from .cleaning import Denoiser, NetworkDenoiser, denoise
from .warping import Source, Warped, photo_sources, warp_photos
from .weights import load_network, save_network

__all__ = [
    "Buffers",
    "Denoiser",
    "NetworkDenoiser",
    "Source",
    "Warped",
    "denoise",
    "load_network",
    "photo_sources",
    "photo_support",
    "render_buffers",
    "save_network",
    "warp_photos",
]
