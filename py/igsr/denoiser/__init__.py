"""The denoiser: takes floaters, blur and holes out of renders of scenes with few photos.

``denoise`` cleans a render and gives a confidence for each pixel. It looks at what the rasterizer
knows of the render (``render_buffers``) and at the photos, warped to its camera
(``photo_sources``). Here is inference only; ``igsr.denoiser.training`` makes the weights.

Names are imported when they are first used (PEP 562), so that command lines load no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

#: Where each public name is defined.
_HOMES = {
    "buffers": ("Buffers", "photo_support", "render_buffers"),
    "cleaning": ("Denoiser", "NetworkDenoiser", "denoise"),
    "warping": ("Source", "Warped", "photo_sources", "warp_photos"),
    "weights": ("load_network", "save_network"),
}
_HOME_OF = {name: f"igsr.denoiser.{home}" for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'igsr.denoiser' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
