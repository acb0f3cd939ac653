"""gsplat's CUDA kernels on the scenes that igsr's are timed on, where CUDA and gsplat are."""

from __future__ import annotations

import importlib
import importlib.util
import time
from typing import Any

import numpy as np
import torch

from igsr.benchmark.scenes import Arrays, Scene
from igsr.benchmark.timed_work import repeated
from igsr.errors import IgsrError

NAME = "gsplat"


def why_not() -> str | None:
    """Why gsplat's kernels cannot be timed here; None where they can."""
    if not torch.cuda.is_available():
        return "PyTorch finds no CUDA device"
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed in this environment"
    return None


def gsplat_rows(
    workload: str, scene: Scene, v_image: Arrays, seconds: float, device: str = "cuda"
) -> list[dict[str, Any]]:
    """Forward and backward of gsplat's ``rasterization``, timed between two synchronizations.

    Args:
        workload: its name.
        scene: what is drawn, with raw parameters.
        v_image: "v_color" [H, W, 3] and "v_alpha" [H, W].
        seconds: how long it is repeated.
        device: of torch.

    Raises:
        IgsrError: gsplat fails.
    """
    # Not imported by name: where it is not installed, there is nothing to check types against.
    gsplat = importlib.import_module(NAME)

    def tensor(array: Any) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array, np.float32), device=device)

    names = ("means", "quats", "scales", "opacities", "colors")
    parameters = {name: tensor(scene.splats[name]).requires_grad_() for name in names}
    fx, fy, cx, cy = (float(x) for x in scene.intrinsics)
    camera = {
        "viewmats": tensor(scene.viewmat)[None],
        "Ks": tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])[None],
        "width": scene.width,
        "height": scene.height,
        "sh_degree": scene.sh_degree,
        "backgrounds": tensor(scene.background)[None],
    }
    v_color, v_alpha = tensor(v_image["v_color"])[None], tensor(v_image["v_alpha"])[None, ..., None]

    def done() -> float:
        if device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def once(repeats: int) -> dict[str, Any]:
        given = dict(parameters)
        if scene.raw_parameters:
            given["scales"] = given["scales"].exp()
            given["opacities"] = given["opacities"].sigmoid()
        began = done()
        colors, alphas, _ = gsplat.rasterization(**given, **camera)
        drawn = done()
        torch.autograd.backward([colors, alphas], [v_color, v_alpha])
        ended = done()
        return {
            "forward": np.array([1e3 * (drawn - began)]),
            "backward": np.array([1e3 * (ended - drawn)]),
        }

    try:
        times = repeated(once, seconds)
    except Exception as error:  # whatever another library raises, the report goes on
        raise IgsrError(f"gsplat {getattr(gsplat, '__version__', '')} failed: {error}") from error
    return [
        {
            "workload": workload,
            "backend": NAME,
            "pass": name,
            "splats": len(scene.splats["means"]),
            "width": scene.width,
            "height": scene.height,
            "ms": float(ms.min()),
            "ms_median": float(np.median(ms)),
            "repeats": len(ms),
        }
        for name, ms in times.items()
    ]
