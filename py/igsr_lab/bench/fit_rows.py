"""Rows of whole fit steps (W3): the built-in fit, and a custom loop through autograd.

Gradients are compared with the f64 reference and a loss in f64. Those of the built-in fit are read
from Adam's first moments: after one step from zero, they are a tenth of the gradients.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from igsr import _core
from igsr._internal.choices import Backend
from igsr.capture import Capture, View
from igsr.errors import IgsrError
from igsr.fitting.fingerprint import fingerprint
from igsr.fitting.fit_capture import fit_capture
from igsr.rendering.rasterization import rasterization
from igsr.rendering.renders import intrinsics_of, viewmat_about
from igsr.splats import Splats
from igsr_lab.bench import oracle
from igsr_lab.bench.comparison import (
    BOUND_3D,
    Band,
    Error,
    errors_row,
    gradient_error,
    picture_error,
    size_row,
)
from igsr_lab.bench.scenes import PARAMETERS, Arrays, Scene
from igsr_lab.bench.stage_rows import MIN_REPEATS, SECONDS, timing_row

#: Number of views that a step is timed on.
VIEWS = 4
#: Steps from one state before it is reset: more would fit the model to the one photo.
STEPS_PER_STATE = 8
#: Number of the first step: all SH degrees are in use, the rate of means has decayed.
FIRST_STEP = 5000
STEPS_OF_FIT = 10_000
#: Weight of new gradients in Adam's first moments.
FIRST_MOMENT = 0.1
#: A model for W3 may have fewer splats by this fraction.
COUNT_TOLERANCE = 0.05
#: Relocation adds 5 % every 100 steps: from 20 000 to 100 000 splats in 3 300.
FIT_STEPS = 5000

#: The fit's loss: weight of D-SSIM, SSIM's window and constants (docs/how-it-works/numerics.md).
SSIM_WEIGHT = 0.2
SSIM_SIGMA_PX = 1.5
SSIM_SIDE_PX = 11
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
#: The sign of smaller residuals depends on rounding.
KINK = 2e-6
#: Charbonnier's smoothing of |x|, for colors in [0, 1].
CHARBONNIER_EPSILON = 1e-3

#: From a picture and a photo [H, W, 3] and the mask of the pixels that count [H, W], None for all.
Loss = Callable[[Tensor, Tensor, Tensor | None], Tensor]


@dataclass(frozen=True)
class Shot:
    """A scene with raw parameters and the photo to fit, uint8 [H, W, 3 or 4]."""

    scene: Scene
    photo: npt.NDArray[np.uint8]

    def target(self) -> npt.NDArray[np.float64]:
        """The photo over the scene's background, [H, W, 3] in [0, 1]."""
        pixels = self.photo.astype(np.float64) / 255.0
        if pixels.shape[2] == 3:
            return pixels
        alpha = pixels[..., 3:]
        return pixels[..., :3] * alpha + self.scene.background * (1.0 - alpha)


def _shot(view: View, splats: Splats) -> Shot:
    """A view over white."""
    scene = Scene(
        splats={
            "means": splats.means,
            "quats": splats.quats,
            "scales": splats.scales,
            "opacities": splats.opacities,
            "colors": splats.sh,
        },
        sh_degree=splats.sh_degree,
        raw_parameters=True,
        viewmat=viewmat_about(splats.origin, view.camera.viewmat),
        intrinsics=intrinsics_of(view.camera.K),
        width=view.camera.width,
        height=view.camera.height,
        background=np.ones(3, np.float32),
    )
    return Shot(scene, np.ascontiguousarray(view.image))


def model_path(capture: Capture, count: int, models: Path, seed: int) -> Path:
    """File of ``fitted_model``; its name has everything that the fit depends on."""
    photos = f"{capture.path.resolve().name}-{fingerprint(capture.train_views)[:12]}"
    return models / f"{photos}-{count}-seed{seed}-{FIT_STEPS}steps.ply"


def fitted_model(capture: Capture, count: int, models: Path, seed: int) -> Splats:
    """A model of ``capture`` with ``count`` splats: from the folder ``models``, else fitted."""
    path = model_path(capture, count, models, seed)
    if path.is_file():
        return Splats.load(path)
    # MCMC grows to the maximum; original density control would stop earlier.
    splats = fit_capture(
        capture,
        steps=FIT_STEPS,
        seed=seed,
        max_splats=count,
        density="mcmc",
        remove_floaters=False,
        backdrop=False,
    ).splats
    if len(splats) < (1.0 - COUNT_TOLERANCE) * count:
        raise IgsrError(
            f"A fit of {capture.path} ended with {len(splats)} splats, not {count}; "
            "give another --capture."
        )
    splats.save(path)
    return splats


def fit_loss(picture: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
    """The fit's loss on [H, W, 3]: 0.8 L1 + 0.2 (1 - SSIM), zero-padded."""
    x, y = picture.permute(2, 0, 1)[:, None], photo.permute(2, 0, 1)[:, None]
    at = torch.arange(SSIM_SIDE_PX, dtype=picture.dtype, device=picture.device)
    at = at - SSIM_SIDE_PX // 2
    line = torch.exp(-(at**2) / (2.0 * SSIM_SIGMA_PX**2))
    line = line / line.sum()
    window = (line[:, None] * line[None, :])[None, None]

    def mean(values: Tensor) -> Tensor:
        return conv2d(values, window, padding=SSIM_SIDE_PX // 2)

    mx, my = mean(x), mean(y)
    xx, yy, xy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    ssim = (2 * mx * my + SSIM_C1) * (2 * xy + SSIM_C2)
    ssim = ssim / ((mx * mx + my * my + SSIM_C1) * (xx + yy + SSIM_C2))
    l1 = (picture - photo).abs().mean(dim=2)
    per_pixel = (1.0 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1.0 - ssim[:, 0].mean(dim=0))
    return per_pixel.mean() if mask is None else per_pixel[mask].mean()


def charbonnier(picture: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
    """The custom loop's loss, a smooth L1."""
    difference = picture - photo if mask is None else (picture - photo)[mask]
    return torch.sqrt(difference**2 + CHARBONNIER_EPSILON**2).mean()


@dataclass(frozen=True)
class Expected:
    """The reference's gradients for a shot, and the error of a backend's picture."""

    gradients: Arrays  # of the loss
    #: The same, with the loss's gradient at the backend's picture. This leaves out the picture's
    #: rounding, which a loss with kinks like L1 amplifies.
    gradients_from_picture: Arrays
    picture: Error  # error of the backend's picture
    band: Band  # number of pixels that may differ, and number that do
    #: bool [H, W], pixels whose loss counts: none at the kink of L1, and none whose SSIM window has
    #: a pixel that is left out.
    mask: npt.NDArray[np.bool_]


def _expected(shot: Shot, loss: Loss, backend: str) -> Expected:
    scene = shot.scene
    dtype = _core.working_dtype(backend)
    projected = _core.project(*scene.arrays(dtype), **scene.options(), backend=backend)
    got = _core.rasterize(
        projected,
        width=scene.width,
        height=scene.height,
        background=scene.background.astype(dtype),
        backend=backend,
    )
    exact = oracle.project(scene, projected)
    crops = oracle.crops(exact, scene.width, scene.height)
    shape = (scene.height, scene.width)
    image = oracle.picture(exact, crops, shape, scene.background)
    in_band = oracle.band(exact, crops, shape, oracle.ALPHA_BAND_3D)
    error, band = picture_error(got, image, in_band, BOUND_3D[backend])
    mask = np.ones(shape, dtype=bool)
    reach = SSIM_SIDE_PX // 2
    for y, x in np.argwhere(band.left_out):
        mask[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1] = False
    residual = np.abs(image["color"] - shot.target())
    mask &= ~((residual > 0.0) & (residual < KINK)).any(axis=2)
    zero = np.zeros(shape)

    def gradients_at(picture: npt.NDArray[Any]) -> Arrays:
        color = torch.from_numpy(picture.astype(np.float64)).requires_grad_()
        loss(color, torch.from_numpy(shot.target()), torch.from_numpy(mask)).backward()
        assert color.grad is not None
        v_image = {"v_color": color.grad.numpy(), "v_alpha": zero, "v_depth": zero}
        v2d = oracle.gradients2d(exact, crops, image, v_image, scene.background)
        v = oracle.gradients3d(scene, exact, v2d)
        return {f"v_{name}": v[f"v_{name}"] for name in PARAMETERS}

    of_both = gradients_at(image["color"]), gradients_at(got["color"])
    return Expected(*of_both, error, band, mask)


def fitter(shot: Shot, backend: str, mask: npt.NDArray[np.bool_] | None = None) -> _core.Fitter:
    """A fit of the shot's scene to its photo, without density control, from zero moments."""
    scene = shot.scene
    splats = {"sh" if name == "colors" else name: a for name, a in scene.splats.items()}
    count = len(splats["means"])
    state: Arrays = dict(splats)
    for moment in ("first", "second"):
        state |= {f"{moment}_{name}": np.zeros_like(array) for name, array in splats.items()}
    for statistic in ("grad_sum", "seen"):
        state[f"stats_{statistic}"] = np.zeros(count, np.float32)
    state["step"] = np.array([FIRST_STEP], dtype=np.uint32)
    config = {
        "steps": STEPS_OF_FIT,
        "sh_degree": scene.sh_degree,
        "max_splats": count,
        "density": "fixed",
        "background": scene.background.tolist(),
    }
    return _core.Fitter(
        [shot.photo],
        [mask],
        [None],
        [(1, None)],
        scene.viewmat[None],
        scene.intrinsics[None],
        state,
        config,
        backend,
    )


def fit_step_ms(shot: Shot, backend: str, seconds: float) -> list[float]:
    """Milliseconds per step of the built-in fit, each within a few steps of the given scene."""
    times: list[float] = []
    started = time.perf_counter()
    while len(times) < MIN_REPEATS or time.perf_counter() - started < seconds:
        running = fitter(shot, backend)
        running.step(1)  # allocates, and wakes a device
        before = time.perf_counter()
        running.step(1)
        # A GPU's steps are read back once per call; a call takes up to 20 ms.
        steps = min(STEPS_PER_STATE, math.ceil(0.02 / (time.perf_counter() - before)))
        for _ in range(STEPS_PER_STATE // steps):
            before = time.perf_counter()
            running.step(steps)
            times.append(1e3 * (time.perf_counter() - before) / steps)
        del running  # or two states would count as the fit's memory
    return times


def _fit_gradients(shot: Shot, backend: str, mask: npt.NDArray[np.bool_]) -> Arrays:
    """Gradients of one step of the built-in fit, from Adam's first moments."""
    running = fitter(shot, backend, mask)
    running.step(1)
    state = running.state()
    return {
        f"v_{name}": state["first_sh" if name == "colors" else f"first_{name}"].astype(np.float64)
        / FIRST_MOMENT
        for name in PARAMETERS
    }


def adam(parameters: Mapping[str, Tensor], **options: Any) -> torch.optim.Adam:
    """Torch's Adam at the fit's rates, with a tenth of the rate for means."""
    rates = {"means": 1.6e-5, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2}
    groups = [
        {"params": [tensor], "lr": rates.get(name, 2.5e-3)} for name, tensor in parameters.items()
    ]
    return torch.optim.Adam(groups, eps=1e-15, **options)


class CustomLoop:
    """A fit by ``igsr.rasterization``, torch's Adam and a Charbonnier loss.

    Rates are the fit's, constant, except a tenth for means and one rate for all of SH.
    """

    def __init__(
        self, shot: Shot, backend: Backend, mask: npt.NDArray[np.bool_] | None = None
    ) -> None:
        scene = shot.scene
        self.scene, self.backend = scene, backend
        self.parameters = {
            name: torch.from_numpy(scene.splats[name].copy()).requires_grad_()
            for name in PARAMETERS
        }
        self.optimizer = adam(self.parameters)
        fx, fy, cx, cy = scene.intrinsics
        self.K = torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]])
        self.viewmat = torch.from_numpy(scene.viewmat)[None]
        self.background = torch.from_numpy(scene.background)[None]
        self.photo = torch.from_numpy(shot.target().astype(np.float32))
        self.mask = None if mask is None else torch.from_numpy(mask)

    def backward(self) -> None:
        """Forward, loss and backward."""
        p = self.parameters
        picture, _, _ = rasterization(
            p["means"],
            p["quats"],
            torch.exp(p["scales"]),
            torch.sigmoid(p["opacities"]),
            p["colors"],
            self.viewmat,
            self.K,
            self.scene.width,
            self.scene.height,
            sh_degree=self.scene.sh_degree,
            backgrounds=self.background,
            packed=False,
            backend=self.backend,
        )
        self.optimizer.zero_grad()
        charbonnier(picture[0], self.photo, self.mask).backward()

    def step(self) -> None:
        """One whole step."""
        self.backward()
        self.optimizer.step()


def _custom_loop_ms(shot: Shot, backend: Backend, seconds: float) -> list[float]:
    """Milliseconds per step of the custom loop, each within a few steps of the given scene."""
    times: list[float] = []
    started = time.perf_counter()
    while len(times) < MIN_REPEATS or time.perf_counter() - started < seconds:
        loop = CustomLoop(shot, backend)
        loop.step()
        for _ in range(STEPS_PER_STATE):
            before = time.perf_counter()
            loop.step()
            times.append(1e3 * (time.perf_counter() - before))
    return times


def _custom_gradients(shot: Shot, backend: Backend, mask: npt.NDArray[np.bool_]) -> Arrays:
    loop = CustomLoop(shot, backend, mask)
    loop.backward()
    found = {name: tensor.grad for name, tensor in loop.parameters.items()}
    return {f"v_{n}": grad.numpy() for n, grad in found.items() if grad is not None}


def step_rows(
    workload: str, shots: list[Shot], backend: str, seconds: float = SECONDS
) -> list[dict[str, Any]]:
    """One step of the built-in fit, and one of the custom loop.

    The time is the mean over the shots of each one's fastest step. Errors are the largest over the
    shots, and the mean of their means.
    """
    scene = shots[0].scene
    count = len(scene.splats["means"])
    passes: list[tuple[str, Loss, Any, Any]] = [
        ("fit step", fit_loss, fit_step_ms, _fit_gradients),
        ("fit step, own loop", charbonnier, _custom_loop_ms, _custom_gradients),
    ]
    rows = []
    for name, loss, time_steps, gradients_of in passes:
        times = [time_steps(shot, backend, seconds / len(shots)) for shot in shots]
        fastest = np.array([min(ms) for ms in times])
        pictures, gradients, backwards, bands = [], [], [], []
        for shot in shots:
            expected = _expected(shot, loss, backend)
            got = gradients_of(shot, backend, expected.mask)
            pictures.append(expected.picture)
            gradients.append(gradient_error(got, expected.gradients))
            backwards.append(gradient_error(got, expected.gradients_from_picture))
            bands.append(expected.band)
        worst = max(gradients, key=lambda error: error.max)
        rows.append(
            {
                **size_row(workload, backend, count, scene.width, scene.height),
                "pass": name,
                "views": len(shots),
                **timing_row(fastest, backend, None),
                "ms": float(np.mean(fastest)),
                "ms_median": float(np.mean([np.median(ms) for ms in times])),
                "repeats": sum(len(ms) for ms in times),
                **errors_row("gradients", worst, bands[0]),
                "mean_error": float(np.mean([error.mean for error in gradients])),
                "max_error_from_picture": max(error.max for error in backwards),
                "picture_max_error": max(error.max for error in pictures),
                "picture_mean_error": float(np.mean([error.mean for error in pictures])),
                "compared_pixels": sum(band.of for band in bands),
                "band_pixels": sum(band.pixels for band in bands),
                "left_out_pixels": sum(int(band.left_out.sum()) for band in bands),
            }
        )
    return rows


def capture_rows(
    capture: Capture, count: int, backend: str, models: Path, seed: int, seconds: float = SECONDS
) -> list[dict[str, Any]]:
    """W3: whole fit steps on a fitted capture with ``count`` splats."""
    splats = fitted_model(capture, count, models, seed)
    views = capture.train_views
    indices = np.linspace(0, len(views) - 1, min(VIEWS, len(views))).astype(int)
    return step_rows("W3", [_shot(views[i], splats) for i in indices], backend, seconds)
