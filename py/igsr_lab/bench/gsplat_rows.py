"""Rows of gsplat's CUDA kernels on igsr's scenes, if CUDA and gsplat are available."""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr import _core
from igsr.errors import IgsrError
from igsr_lab.bench.comparison import BOUND_3D, errors_row, size_row
from igsr_lab.bench.fit_rows import SSIM_WEIGHT, Shot, adam, fit_loss
from igsr_lab.bench.scenes import Arrays, Scene
from igsr_lab.bench.stage_rows import compare_picture, repeated

NAME = "gsplat"


def why_not() -> str | None:
    """The reason that gsplat cannot be timed here, or None."""
    if not torch.cuda.is_available():
        return "PyTorch finds no CUDA device"
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed in this environment"
    return None


def step_loss() -> tuple[str, Callable[[Tensor, Tensor], Tensor]]:
    """The fit's loss with a name: by the package fused_ssim if it is installed, else by conv2d."""
    if importlib.util.find_spec("fused_ssim") is None:
        return "conv2d", lambda picture, photo: fit_loss(picture, photo, None)
    fused_ssim = importlib.import_module("fused_ssim").fused_ssim

    def fused(picture: Tensor, photo: Tensor) -> Tensor:
        planes = (image.permute(2, 0, 1)[None] for image in (picture, photo))
        l1 = (picture - photo).abs().mean()
        loss: Tensor = (1.0 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1.0 - fused_ssim(*planes))
        return loss

    return "fused_ssim", fused


def gsplat_rows(
    workload: str,
    scene: Scene,
    v_image: Arrays,
    seconds: float,
    device: str = "cuda",
    *,
    photo: npt.NDArray[np.uint8] | None = None,
    chosen: Callable[[list[Any]], list[Any]] = list,
) -> list[dict[str, Any]]:
    """Times and errors of gsplat's ``rasterization``, forward and backward, and of a fit step.

    The step has igsr's loss and torch's fused Adam, as much work as igsr's step. Its row has the
    gradients' error.

    Args:
        workload: name for the rows.
        scene: with raw parameters if there is a photo.
        v_image: gradients of the image for the pass backward.
        seconds: time that each pass is repeated.
        device: of torch.
        photo: uint8 [H, W, 3 or 4] to fit; None leaves the step out.
        chosen: chooses the crops that are compared with the reference.
    """
    # Not a static import, which type checkers could not resolve if it is not installed.
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
        # gsplat 1.5.3 does not support backgrounds with packing.
        "packed": False,
    }

    def synchronized() -> float:
        if device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def clear_gradients() -> None:
        for value in parameters.values():
            value.grad = None

    def rendered() -> tuple[torch.Tensor, torch.Tensor]:
        given = dict(parameters)
        if scene.raw_parameters:
            given["scales"] = given["scales"].exp()
            given["opacities"] = given["opacities"].sigmoid()
        colors, alphas, _ = gsplat.rasterization(**given, **camera)
        return colors, alphas

    def on_device(v_image: Arrays) -> list[torch.Tensor]:
        return [tensor(v_image["v_color"])[None], tensor(v_image["v_alpha"])[None, ..., None]]

    def once(repeats: int) -> dict[str, Any]:
        clear_gradients()
        began = synchronized()
        picture = rendered()
        ended = synchronized()
        torch.autograd.backward(picture, v_given)
        return {
            "forward": np.array([1e3 * (ended - began)]),
            "backward": np.array([1e3 * (synchronized() - ended)]),
        }

    v_given = on_device(v_image)

    def gradients(counted: Arrays) -> Arrays:
        clear_gradients()
        torch.autograd.backward(picture, on_device(counted))
        return {f"v_{name}": array(value.grad) for name, value in parameters.items()}

    try:
        times = repeated(once, seconds)
        picture = rendered()
        alpha = array(picture[1])[0, ..., 0]
        got = {"color": array(picture[0])[0], "alpha": alpha, "transmittance": 1.0 - alpha}
        own = scene.arrays(_core.working_dtype("cpu"))
        in_sight = _core.project(*own, **scene.options(), backend="cpu")
        # gsplat does not render depth with color.
        v_colors = {**v_image, "v_depth": np.zeros_like(v_image["v_depth"])}
        compared, _ = compare_picture(
            scene, in_sight, got, gradients, BOUND_3D["gpu"], v_colors, chosen
        )
        loss_name, loss = step_loss()
        if photo is not None:
            target = tensor(Shot(scene, photo).target())
            optimizer = adam(parameters, fused=device == "cuda")

            def step(repeats: int) -> dict[str, Any]:
                began = synchronized()
                optimizer.zero_grad()
                loss(rendered()[0][0], target).backward()
                optimizer.step()
                return {"fit step": np.array([1e3 * (synchronized() - began)])}

            times |= repeated(step, seconds)
    except Exception as error:  # of any kind; the report continues
        raise IgsrError(f"gsplat {getattr(gsplat, '__version__', '')} failed: {error}") from error
    errors = {
        "forward": errors_row("picture", compared.picture, compared.band),
        "backward": errors_row("gradients", compared.gradients, compared.band),
        "fit step": errors_row("gradients", compared.gradients, compared.band)
        | {"loss": loss_name},
    }
    return [
        {
            **size_row(workload, NAME, len(scene.splats["means"]), scene.width, scene.height),
            "pass": name,
            "ms": float(ms.min()),
            "ms_median": float(np.median(ms)),
            "repeats": len(ms),
            **errors[name],
        }
        for name, ms in times.items()
    ]
