"""Rows of whole fit steps (W3): the built-in fit, and a loop of one's own through autograd.

The gradients of a fit step are the fit's own: after one step from moments of zero, Adam's first
moments hold a tenth of them. The expected ones come from the f64 reference and a loss in f64.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
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
from igsr.fitting.fit_capture import fingerprint, fit
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
)
from igsr_lab.bench.scenes import PARAMETERS, Arrays, Scene
from igsr_lab.bench.stage_rows import MIN_REPEATS, SECONDS, timing_row

#: Views that a step is timed on; they differ in what they show.
VIEWS = 4
#: Steps from one state before it is set up anew: more would fit the model to the one photo.
STEPS_PER_STATE = 8
#: Steps done before, by number only: all SH degrees are in use, the centers' rate has decayed.
STEPS_BEFORE, STEPS_OF_FIT = 5000, 10_000
#: What the fit weighs new gradients with in Adam's first moments.
FIRST_MOMENT = 0.1
#: A model that is fitted for W3 may fall short of the number of splats by this part.
COUNT_TOLERANCE = 0.05
#: Relocation lets a model grow by 5 % every 100 steps, from 20 000 to 100 000 splats in 3 300.
FIT_STEPS = 5000

#: The fit's loss: part of D-SSIM, SSIM's window and constants (docs/how-it-works/numerics.md).
SSIM_WEIGHT = 0.2
SSIM_SIGMA, SSIM_SIDE = 1.5, 11
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2

#: Residuals nearer to 0 than this may round to either side of it.
KINK = 2e-6

#: Charbonnier's smoothing of |x|, in units of the picture's range.
CHARBONNIER_EPSILON = 1e-3

#: Of a picture, a photo [H, W, 3] and the mask of the pixels that count [H, W].
Loss = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Shot:
    """A scene with raw parameters and the photo that it is fitted to, uint8 [H, W, 3 or 4]."""

    scene: Scene
    photo: npt.NDArray[np.uint8]

    def target(self) -> npt.NDArray[np.float64]:
        """The photo over the scene's background, [H, W, 3] in 0..1."""
        pixels = self.photo.astype(np.float64) / 255.0
        if pixels.shape[2] == 3:
            return pixels
        alpha = pixels[..., 3:]
        return pixels[..., :3] * alpha + self.scene.background * (1.0 - alpha)


def shots_of(capture: Capture, splats: Splats) -> list[Shot]:
    """Some views of a capture, evenly chosen, over white, with a model of it."""
    views = capture.train_views
    chosen = [views[i] for i in np.linspace(0, len(views) - 1, min(VIEWS, len(views))).astype(int)]
    return [_shot(view, splats) for view in chosen]


def _shot(view: View, splats: Splats) -> Shot:
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
    """Where ``fitted_model`` keeps a model; the name holds all that the fit depends on."""
    photos = f"{capture.path.resolve().name}-{fingerprint(capture.train_views)[:12]}"
    return models / f"{photos}-{count}-seed{seed}-{FIT_STEPS}steps.ply"


def fitted_model(capture: Capture, count: int, models: Path, seed: int) -> Splats:
    """A model of ``capture`` with ``count`` splats: from the folder ``models``, else fitted.

    Raises:
        IgsrError: the fit did not reach the number of splats, or the model cannot be written.
    """
    path = model_path(capture, count, models, seed)
    if path.is_file():
        return Splats.load(path)
    # Relocation grows the model up to the number asked for; the original control stops where the
    # photos ask for no more, and removing floaters would leave fewer.
    splats = fit(
        capture,
        FIT_STEPS,
        seed=seed,
        max_splats=count,
        density="mcmc",
        remove_floaters=False,
        backdrop=False,
    )
    if len(splats) < (1.0 - COUNT_TOLERANCE) * count:
        raise IgsrError(
            f"A fit of {capture.path} ended with {len(splats)} splats, not {count}; "
            "give another --capture."
        )
    splats.save(path)
    return splats


# ---- the loss in f64, and the gradients it gives ------------------------------------------------


def fit_loss(picture: Tensor, photo: Tensor, mask: Tensor) -> Tensor:
    """The fit's loss on [H, W, 3]: 0.8 L1 + 0.2 (1 - SSIM), zero padding in the window."""
    x, y = picture.permute(2, 0, 1)[:, None], photo.permute(2, 0, 1)[:, None]
    at = torch.arange(SSIM_SIDE, dtype=picture.dtype) - SSIM_SIDE // 2
    line = torch.exp(-(at**2) / (2.0 * SSIM_SIGMA**2))
    line = line / line.sum()
    window = (line[:, None] * line[None, :])[None, None]

    def mean(values: Tensor) -> Tensor:
        return conv2d(values, window, padding=SSIM_SIDE // 2)

    mx, my = mean(x), mean(y)
    xx, yy, xy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    ssim = (2 * mx * my + SSIM_C1) * (2 * xy + SSIM_C2)
    ssim = ssim / ((mx * mx + my * my + SSIM_C1) * (xx + yy + SSIM_C2))
    l1 = (picture - photo).abs().mean(dim=2)
    per_pixel = (1.0 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1.0 - ssim[:, 0].mean(dim=0))
    return per_pixel[mask].mean()


def charbonnier(picture: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
    """The smooth L1 of the loop of one's own."""
    difference = picture - photo if mask is None else (picture - photo)[mask]
    return torch.sqrt(difference**2 + CHARBONNIER_EPSILON**2).mean()


@dataclass(frozen=True)
class Expected:
    """What the reference says of a shot, and how a backend's picture compares.

    Attributes:
        gradients: of the loss, without the pixels that do not count.
        gradients_from_picture: the same, but with the loss's own gradient taken at the backend's
            picture. A loss that bends sharply, as a rounded L1 does at its tip, makes more of the
            picture's rounding than the renderer's backward pass adds; this leaves only the latter.
        picture: error of the backend's picture.
        band: pixels that may differ, and those that do.
        mask: bool [H, W], the pixels whose loss counts: none at the kink of L1, and none whose
            SSIM window holds a pixel that is left out, so that such a pixel has no gradient at all.
    """

    gradients: Arrays
    gradients_from_picture: Arrays
    picture: Error
    band: Band
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
    reach = SSIM_SIDE // 2
    for y, x in np.argwhere(band.left_out):
        mask[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1] = False
    # |x| has no gradient at 0: within rounding of it, its sign is a matter of chance.
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


# ---- the built-in fit ---------------------------------------------------------------------------


def _state(scene: Scene) -> Arrays:
    """A fit's state with moments of zero, as if ``STEPS_BEFORE`` steps had been done."""
    splats = {"sh" if name == "colors" else name: a for name, a in scene.splats.items()}
    count = len(splats["means"])
    state: Arrays = dict(splats)
    for moment in ("first", "second"):
        state |= {f"{moment}_{name}": np.zeros_like(array) for name, array in splats.items()}
    for statistic in ("grad_sum", "seen"):
        state[f"stats_{statistic}"] = np.zeros(count, np.float32)
    state["step"] = np.array([STEPS_BEFORE], dtype=np.uint32)
    return state


def fitter(shot: Shot, backend: str, mask: npt.NDArray[np.bool_] | None = None) -> _core.Fitter:
    """A fit of the shot's scene to its one photo, without density control."""
    scene = shot.scene
    config = {
        "steps": STEPS_OF_FIT,
        "sh_degree": scene.sh_degree,
        "max_splats": len(scene.splats["means"]),
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
        _state(scene),
        config,
        backend,
    )


def fit_step_ms(shot: Shot, backend: str, seconds: float) -> list[float]:
    """Milliseconds per step, each from the scene as it is given (but for a few steps)."""
    times: list[float] = []
    started = time.perf_counter()
    while len(times) < MIN_REPEATS or time.perf_counter() - started < seconds:
        running = fitter(shot, backend)
        running.step(1)  # allocates, and wakes a device
        before = time.perf_counter()
        running.step(1)
        # Steps of a GPU are read back once per call; a call holds up to 20 ms of them.
        steps = min(STEPS_PER_STATE, math.ceil(0.02 / (time.perf_counter() - before)))
        for _ in range(STEPS_PER_STATE // steps):
            before = time.perf_counter()
            running.step(steps)
            times.append(1e3 * (time.perf_counter() - before) / steps)
        # Or the next one's state would stand beside this one's, and count as the fit's memory.
        del running
    return times


def fit_gradients(shot: Shot, backend: str, mask: npt.NDArray[np.bool_]) -> Arrays:
    """The gradients of one step of the built-in fit, out of Adam's first moments."""
    running = fitter(shot, backend, mask)
    running.step(1)
    state = running.state()
    return {
        f"v_{name}": state["first_sh" if name == "colors" else f"first_{name}"].astype(np.float64)
        / FIRST_MOMENT
        for name in PARAMETERS
    }


# ---- a loop of one's own ------------------------------------------------------------------------


class OwnLoop:
    """A fit by ``igsr.rasterization``, torch's Adam and a Charbonnier loss."""

    def __init__(
        self, shot: Shot, backend: Backend, mask: npt.NDArray[np.bool_] | None = None
    ) -> None:
        """Parameters as leaves, at fixed rates.

        They are the fit's, but for the centers', which here is a tenth of the fit's first and knows
        neither extent nor decay, and for all SH coefficients, which here share that of the first.
        """
        scene = shot.scene
        self.scene, self.backend = scene, backend
        self.parameters = {
            name: torch.from_numpy(scene.splats[name].copy()).requires_grad_()
            for name in PARAMETERS
        }
        rates = {"means": 1.6e-5, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2}
        self.optimizer = torch.optim.Adam(
            [
                {"params": [tensor], "lr": rates.get(name, 2.5e-3)}
                for name, tensor in self.parameters.items()
            ],
            eps=1e-15,
        )
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

    def gradients(self) -> Arrays:
        """The gradients of the last backward pass."""
        found = {name: tensor.grad for name, tensor in self.parameters.items()}
        return {f"v_{n}": grad.numpy() for n, grad in found.items() if grad is not None}


def own_loop_ms(shot: Shot, backend: Backend, seconds: float) -> list[float]:
    """Milliseconds per step of the loop of one's own, each nearly from the scene as given."""
    times: list[float] = []
    started = time.perf_counter()
    while len(times) < MIN_REPEATS or time.perf_counter() - started < seconds:
        loop = OwnLoop(shot, backend)
        loop.step()
        for _ in range(STEPS_PER_STATE):
            before = time.perf_counter()
            loop.step()
            times.append(1e3 * (time.perf_counter() - before))
    return times


# ---- rows ---------------------------------------------------------------------------------------


def step_rows(
    workload: str, shots: list[Shot], backend: str, seconds: float = SECONDS
) -> list[dict[str, Any]]:
    """One step of the built-in fit beside one of the loop of one's own.

    The time is the mean over the shots of the fastest step of each; errors are the largest over the
    shots, and the mean of their means.
    """
    scene = shots[0].scene
    passes: list[tuple[str, Loss, Any, Any]] = [
        ("fit step", fit_loss, fit_step_ms, fit_gradients),
        ("fit step, own loop", charbonnier, own_loop_ms, _own_gradients),
    ]
    rows = []
    for name, loss, time_steps, gradients_of in passes:
        fastest, medians, repeats = [], [], 0
        compared = []
        for shot in shots:
            times = time_steps(shot, backend, seconds / len(shots))
            fastest.append(min(times))
            medians.append(float(np.median(times)))
            repeats += len(times)
            expected = _expected(shot, loss, backend)
            got = gradients_of(shot, backend, expected.mask)
            error = gradient_error(got, expected.gradients)
            backward = gradient_error(got, expected.gradients_from_picture)
            compared.append((expected.picture, error, backward, expected.band))
        pictures, gradients, backwards, bands = zip(*compared, strict=True)
        worst = max(gradients, key=lambda error: error.max)
        rows.append(
            {
                "workload": workload,
                "backend": backend,
                "pass": name,
                "splats": len(scene.splats["means"]),
                "width": scene.width,
                "height": scene.height,
                "views": len(shots),
                **timing_row(np.array(fastest), backend, None),
                "ms": float(np.mean(fastest)),
                "ms_median": float(np.mean(medians)),
                "repeats": repeats,
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


def _own_gradients(shot: Shot, backend: Backend, mask: npt.NDArray[np.bool_]) -> Arrays:
    loop = OwnLoop(shot, backend, mask)
    loop.backward()
    return loop.gradients()


def capture_rows(
    capture: Capture, count: int, backend: str, models: Path, seed: int, seconds: float = SECONDS
) -> list[dict[str, Any]]:
    """W3: whole fit steps on a capture after its fit, at ``count`` splats."""
    return step_rows(
        "W3", shots_of(capture, fitted_model(capture, count, models, seed)), backend, seconds
    )
