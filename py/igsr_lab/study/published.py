"""Published results on the photos of the few-photo studies, for their tables.

Figures only, with the paper or repository that states each. The methods ran on their authors' GPUs
with their own code. ``source`` names the scenes and sizes if they differ from the study's.
"""

from __future__ import annotations

from typing import NamedTuple


class Published(NamedTuple):
    """Scores of a method: PSNR in dB, SSIM or None, and their scenes and source."""

    method: str
    psnr: float
    ssim: float | None
    source: str


_FERN = "fern, github.com/myduynn04/ReDI-GS"
_DTU = "mean of DTU's 15 scans"
_BLENDER = "mean of NeRF Synthetic's 8 scenes"

#: By scene (or "dtu") and number of photos.
PUBLISHED: dict[tuple[str, str], tuple[Published, ...]] = {
    ("fern", "3"): (
        Published("ReDI-GS", 23.84, 0.797, _FERN),
        Published("Binocular3DGS", 22.58, 0.758, _FERN),
        Published("CoR-GS", 22.29, 0.745, _FERN),
    ),
    ("fern", "6"): (Published("ReDI-GS", 26.16, 0.875, _FERN),),
    ("fern", "9"): (Published("ReDI-GS", 27.45, 0.903, _FERN),),
    ("dtu", "3"): (
        Published("StereoGS", 22.00, None, f"{_DTU}, arXiv 2606.30545"),
        Published("ICO-GS", 21.77, 0.888, f"{_DTU}, arXiv 2603.02893"),
        Published("Binocular3DGS", 20.71, None, f"{_DTU}, arXiv 2410.18822"),
    ),
    ("dtu", "6"): (
        Published("StereoGS", 25.41, None, f"{_DTU}, arXiv 2606.30545"),
        Published("ICO-GS", 25.09, 0.928, f"{_DTU}, arXiv 2603.02893"),
    ),
    ("dtu", "9"): (
        Published("TWINGS", 28.22, None, f"{_DTU}, arXiv 2605.22069"),
        Published("ICO-GS", 27.19, 0.953, f"{_DTU}, arXiv 2603.02893"),
    ),
    ("chair", "8"): (
        Published("Sparse_GS", 25.65, 0.930, "chair, 800 pixels"),
        Published("ICO-GS", 25.62, None, f"{_BLENDER}, arXiv 2603.02893"),
    ),
    ("lego", "8"): (
        Published("DNGaussian", 24.06, None, "lego, other photos, its issue 40"),
        Published("Sparse_GS", 23.46, 0.894, "lego, 800 pixels"),
        Published("ICO-GS", 25.62, None, f"{_BLENDER}, arXiv 2603.02893"),
    ),
}


def published(scene: str, photos: str) -> tuple[Published, ...]:
    """Return published results on a scene's photos; none for scenes that no paper has."""
    return PUBLISHED.get(("dtu" if scene.startswith("dtu") else scene, photos), ())
