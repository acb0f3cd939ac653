"""igsr: fit a Gaussian-splat scene to a few photos.

>>> import igsr
>>> capture = igsr.load_capture("photos").with_holdout(8)
>>> splats = igsr.fit(capture, steps=5000)
>>> igsr.evaluate(splats, capture).psnr
>>> splats.save("scene.ply")

Names are imported when they are first used (PEP 562): ``import igsr`` alone imports no torch, which
only the extra ``igsr[refine]`` installs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr._core import __version__
    from igsr.capture import Camera, Capture, Exposure, Points, View, load_capture
    from igsr.compaction import Compaction, compact
    from igsr.denoiser import denoise
    from igsr.errors import IgsrError, MissingExtraError
    from igsr.evaluation import Scores, evaluate
    from igsr.fitting import Progress, fit, fit_with_cameras, refine_cameras
    from igsr.floaters import remove_floaters
    from igsr.pose import estimate_poses
    from igsr.refinement import Refined, refine
    from igsr.rendering import Render, render
    from igsr.rendering.exposure import apply_exposure
    from igsr.rendering.rasterization import rasterization
    from igsr.splats import Splats

__all__ = [
    "Camera",
    "Capture",
    "Compaction",
    "Exposure",
    "IgsrError",
    "MissingExtraError",
    "Points",
    "Progress",
    "Refined",
    "Render",
    "Scores",
    "Splats",
    "View",
    "__version__",
    "apply_exposure",
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
    "remove_floaters",
    "render",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "igsr._core": ("__version__",),
            "igsr.capture": ("Camera", "Capture", "Exposure", "Points", "View", "load_capture"),
            "igsr.compaction": ("Compaction", "compact"),
            "igsr.denoiser": ("denoise",),
            "igsr.errors": ("IgsrError", "MissingExtraError"),
            "igsr.evaluation": ("Scores", "evaluate"),
            "igsr.fitting": ("Progress", "fit", "fit_with_cameras", "refine_cameras"),
            "igsr.floaters": ("remove_floaters",),
            "igsr.pose": ("estimate_poses",),
            "igsr.refinement": ("Refined", "refine"),
            "igsr.rendering": ("Render", "render"),
            "igsr.rendering.exposure": ("apply_exposure",),
            "igsr.rendering.rasterization": ("rasterization",),
            "igsr.splats": ("Splats",),
        },
    )
