"""The denoiser: cleans renders of poorly known scenes, and says where the result may be trusted."""

from __future__ import annotations

from igsr.denoiser.buffers import Buffers, photo_support, render_buffers
from igsr.denoiser.cleaning import Denoiser, NetworkDenoiser, denoise
from igsr.denoiser.warping import Source, Warped, photo_sources, warp_photos
from igsr.denoiser.weights import load_network, save_network

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
