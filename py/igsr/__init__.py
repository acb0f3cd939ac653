"""igsr: fit a Gaussian-splat scene to a few photos.

>>> import igsr
>>> result = igsr.fit("photos", holdout=8, out="out")
>>> result.scores.psnr
>>> result.splats.save("scene.ply")

Names are imported when they are first used (PEP 562): ``import igsr`` alone imports no torch, which
only the extra ``igsr[refine]`` installs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr._core import __version__
    from igsr.cameras import find_cameras
    from igsr.capture import (
        Camera,
        Capture,
        Exposure,
        Points,
        PseudoView,
        View,
        load_capture,
    )
    from igsr.compaction import Compaction, compact
    from igsr.denoiser import denoise
    from igsr.errors import IgsrError, MissingExtraError
    from igsr.evaluation import Scores, evaluate
    from igsr.fitting import FitResult, fit, refine_cameras
    from igsr.floaters import remove_floaters
    from igsr.refinement import Refined, refine
    from igsr.rendering import Render, render
    from igsr.rendering.exposure import apply_exposure
    from igsr.rendering.rasterization import rasterization
    from igsr.run import Event
    from igsr.splats import Splats

__all__ = [
    "Camera",
    "Capture",
    "Compaction",
    "Event",
    "Exposure",
    "FitResult",
    "IgsrError",
    "MissingExtraError",
    "Points",
    "PseudoView",
    "Refined",
    "Render",
    "Scores",
    "Splats",
    "View",
    "__version__",
    "apply_exposure",
    "compact",
    "denoise",
    "evaluate",
    "find_cameras",
    "fit",
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
            "igsr.capture": (
                "Camera",
                "Capture",
                "Exposure",
                "Points",
                "PseudoView",
                "View",
                "load_capture",
            ),
            "igsr.compaction": ("Compaction", "compact"),
            "igsr.denoiser": ("denoise",),
            "igsr.errors": ("IgsrError", "MissingExtraError"),
            "igsr.evaluation": ("Scores", "evaluate"),
            "igsr.fitting": ("FitResult", "fit", "refine_cameras"),
            "igsr.floaters": ("remove_floaters",),
            "igsr.cameras": ("find_cameras",),
            "igsr.refinement": ("Refined", "refine"),
            "igsr.rendering": ("Render", "render"),
            "igsr.rendering.exposure": ("apply_exposure",),
            "igsr.rendering.rasterization": ("rasterization",),
            "igsr.run": ("Event",),
            "igsr.splats": ("Splats",),
        },
    )
