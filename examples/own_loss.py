"""Fit splats with another loss and optimizer.

`igsr.rasterization` is a differentiable torch function, so a fit is an ordinary training loop:

    python examples/own_loss.py [examples/tea_table] [--steps 1000]

The number of splats stays as it is here; gsplat's strategies, which add and remove splats, run on
`igsr.rasterization` too. `python -m igsr_lab bench` times such a loop and the built-in fit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import igsr
from igsr.evaluation.scores import default_split
from igsr.fitting.initialization.initial_splats import initial_splats

RATES = {"means": 2e-3, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh": 2.5e-3}
EPSILON = 1e-3


def charbonnier(picture: torch.Tensor, photo: torch.Tensor) -> torch.Tensor:
    """L1 with a rounded tip (Charbonnier et al. 1994)."""
    return torch.sqrt((picture - photo) ** 2 + EPSILON**2).mean()


def over(photo: np.ndarray, background: torch.Tensor) -> torch.Tensor:
    """A photo, uint8 [H, W, 3 or 4], over a background color; float32 [H, W, 3]."""
    pixels = torch.from_numpy(photo).float() / 255.0
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3:]
    return pixels[..., :3] * alpha + background * (1.0 - alpha)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    here = Path(__file__).parent
    parser.add_argument("capture", nargs="?", default=str(here / "tea_table"))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--splats", type=int, default=10_000)
    parser.add_argument("--backend", default="auto", choices=["auto", "cpu", "gpu"])
    arguments = parser.parse_args()

    capture = igsr.load_capture(arguments.capture)
    start, _ = initial_splats(capture, seed=0, max_splats=arguments.splats, sh_degree=1)
    parameters = {name: torch.from_numpy(getattr(start, name)).requires_grad_() for name in RATES}
    optimizer = torch.optim.Adam(
        [{"params": [parameters[name]], "lr": rate} for name, rate in RATES.items()], eps=1e-15
    )
    background = torch.ones(3)
    random = np.random.default_rng(0)
    views = capture.train_views

    for step in range(1, arguments.steps + 1):
        view = views[random.integers(len(views))]
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ start.origin  # means are relative to the origin
        picture, _, _ = igsr.rasterization(
            parameters["means"],
            parameters["quats"],
            torch.exp(parameters["scales"]),
            torch.sigmoid(parameters["opacities"]),
            parameters["sh"],
            torch.from_numpy(viewmat)[None],
            torch.from_numpy(view.camera.K)[None],
            view.camera.width,
            view.camera.height,
            sh_degree=1,
            backgrounds=background[None],
            backend=arguments.backend,
        )
        loss = charbonnier(picture[0], over(view.image, background))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 100 == 0 or step == arguments.steps:
            print(f"step {step}  loss {loss.item():.4f}", flush=True)

    fitted = {name: tensor.detach().numpy() for name, tensor in parameters.items()}
    splats = igsr.Splats(**fitted, origin=start.origin)
    split = default_split(capture)  # test views, if there are any: the loop never saw them
    scores = igsr.evaluate(splats, capture, split, background=(1.0, 1.0, 1.0))
    print(f"PSNR {scores['psnr']:.2f} dB on the {split} views")


if __name__ == "__main__":
    main()
