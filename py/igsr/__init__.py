"""igsr: from a handful of photos with known cameras to a Gaussian-splat scene.

>>> import igsr
>>> capture = igsr.load_capture("photos").with_holdout(8)
>>> splats = igsr.fit(capture, steps=5000)
>>> igsr.evaluate(splats, capture)["psnr"]
>>> splats.save("scene.ply")
"""

from __future__ import annotations

from ._core import __version__
from .capture import Camera, Capture, Points, View, load_capture
from .compaction import Compaction, compact
from .denoiser import denoise
from .errors import IgsrError
from .evaluation import evaluate
from .fitting import Progress, fit, fit_with_cameras
from .pose import estimate_poses
from .poses import refine_cameras
from .rasterization import rasterization
from .refinement import Refined, refine
from .rendering import Render, render
from .splats import Splats

__all__ = [
    "Camera",
    "Capture",
    "Compaction",
    "IgsrError",
    "Points",
    "Progress",
    "Refined",
    "Render",
    "Splats",
    "View",
    "__version__",
    "compact",
    "denoise",
    "estimate_poses",
    "evaluate",
    "fit",
    "fit_with_cameras",
    "load_capture",
    "rasterization",
    "refine",
    "refine_cameras",
    "render",
]
