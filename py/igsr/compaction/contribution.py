"""How much each splat contributes to renders; pruning removes those that contribute least."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Camera
from igsr.rendering.renders import project
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Contribution:
    """Contribution of splats to the renders of some cameras. All float64 [N], 0 where not visible.

    Attributes:
        weight: blending weight, summed over pixels and pictures: the area a splat covers, in
            pixels, as far as nothing before it hides it.
        change: root of the squared change of the pictures' colours (of 1) that making the splat
            fully transparent would bring, summed over pixels, channels and pictures; to first
            order, estimated with one random probe per picture. It is small for what is faint or
            hidden, and also for what stands before its own colour.
    """

    weight: Float64
    change: Float64

    @property
    def importance(self) -> Float64:
        """[N]: ``weight`` times ``change``, which orders splats better than either alone."""
        return self.weight * self.change


def contribution(
    splats: Splats, cameras: Iterable[Camera], seed: int = 0, backend: str = "auto"
) -> Contribution:
    """Contribution of each splat to the renders of ``cameras``, over a random background in each.

    Args:
        splats: the scene.
        cameras: of the renders.
        seed: of the backgrounds and the probes.
        backend: "auto", "cpu", "gpu" or "reference".

    Raises:
        ValueError: the parameters cannot be drawn; the message names the argument.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    backend = _core.resolve_backend(backend)
    dtype = _core.working_dtype(backend)
    random = np.random.default_rng([seed, 0xC047])
    weight, squared = np.zeros(len(splats)), np.zeros(len(splats))
    for camera in cameras:
        projected = project(splats, camera, backend)
        background = random.uniform(size=3).astype(dtype)
        image = _core.rasterize(
            projected,
            width=camera.width,
            height=camera.height,
            background=background,
            backend=backend,
        )
        nothing = np.zeros_like(image["alpha"])
        # Of a gradient for random signs the square is, on average, the sum of the squares of the
        # gradients of every pixel: the products of different pixels cancel.
        signs = random.choice(np.array([-1.0, 1.0], dtype), size=image["color"].shape)
        for v_color in (np.ones_like(image["color"]), signs):
            v = _core.rasterize_backward(
                projected,
                image,
                v_color=v_color,
                v_alpha=nothing,
                v_depth=nothing,
                background=background,
                absolute=False,
                backend=backend,
            )
            if v_color is signs:
                squared += np.square(v["v_opacities"].astype(np.float64) * projected["opacities"])
            else:
                # d color / d color of a splat is its weight, the same for all three channels.
                weight += v["v_colors"][:, 0]
    return Contribution(weight, np.sqrt(squared))
