"""gsplat's CUDA kernels on the scenes that igsr's are timed on, where CUDA and gsplat are."""

from __future__ import annotations

import importlib
import importlib.util
import time
from typing import Any

import numpy as np
import torch

from igsr import _core
from igsr.errors import IgsrError
from igsr_lab.bench.comparison import BOUND_3D, errors_row
from igsr_lab.bench.scenes import Arrays, Scene
from igsr_lab.bench.stage_rows import beside_reference
from igsr_lab.bench.timed_work import repeated

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
    """Forward and backward of gsplat's ``rasterization``: times, and errors as igsr's own have.

    Times are between two synchronizations.

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

    def array(tensor: Any) -> Any:
        return tensor.detach().cpu().numpy()

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
        # gsplat 1.5.3 refuses backgrounds where it packs what is in sight.
        "packed": False,
    }

    def done() -> float:
        if device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def drawn() -> tuple[torch.Tensor, torch.Tensor]:
        given = dict(parameters)
        if scene.raw_parameters:
            given["scales"] = given["scales"].exp()
            given["opacities"] = given["opacities"].sigmoid()
        colors, alphas, _ = gsplat.rasterization(**given, **camera)
        return colors, alphas

    def on_device(v_image: Arrays) -> list[torch.Tensor]:
        return [tensor(v_image["v_color"])[None], tensor(v_image["v_alpha"])[None, ..., None]]

    def once(repeats: int) -> dict[str, Any]:
        for one in parameters.values():
            one.grad = None
        began = done()
        picture = drawn()
        ended = done()
        torch.autograd.backward(picture, v_given)
        return {
            "forward": np.array([1e3 * (ended - began)]),
            "backward": np.array([1e3 * (done() - ended)]),
        }

    v_given = on_device(v_image)

    def gradients(counted: Arrays) -> Arrays:
        for one in parameters.values():
            one.grad = None
        torch.autograd.backward(picture, on_device(counted))
        return {f"v_{name}": array(one.grad) for name, one in parameters.items()}

    try:
        times = repeated(once, seconds)
        picture = drawn()
        alpha = array(picture[1])[0, ..., 0]
        got = {"color": array(picture[0])[0], "alpha": alpha, "transmittance": 1.0 - alpha}
        own = scene.arrays(_core.working_dtype("cpu"))
        in_sight = _core.project(*own, **scene.options(), backend="cpu")
        # Depth is a picture of its own there, and has no part in this loss.
        v_drawn = {**v_image, "v_depth": np.zeros_like(v_image["v_depth"])}
        compared, _ = beside_reference(scene, in_sight, got, gradients, BOUND_3D["gpu"], v_drawn)
    except Exception as error:  # whatever another library raises, the report goes on
        raise IgsrError(f"gsplat {getattr(gsplat, '__version__', '')} failed: {error}") from error
    errors = {
        "forward": errors_row("picture", compared.picture, compared.band),
        "backward": errors_row("gradients", compared.gradients, compared.band),
    }
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
            **errors[name],
        }
        for name, ms in times.items()
    ]
