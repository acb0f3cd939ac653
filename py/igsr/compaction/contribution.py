"""Contribution of each splat to renders; compaction prunes the splats that contribute least."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Camera
from igsr.rendering.splat_weights import DifferentiableRender
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Contribution:
    """Contribution of splats to the renders of some cameras. All float64 [N], 0 if invisible.

    Attributes:
        weight: visible area, summed over pictures, pixels.
        change: root of the squared change of the pictures' colors (in [0, 1]) if the splat became
            fully transparent, summed over pixels, channels and pictures; to first order, estimated
            with one random probe per picture. It is small for splats that are faint, hidden, or in
            front of their own color.
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
    """Compute the contribution of each splat to renders, each over a random background.

    Args:
        splats: the scene.
        cameras: of the renders.
        seed: of the backgrounds and the probes.
        backend: "auto", "cpu", "gpu" or "reference".

    Raises:
        ValueError: the parameters cannot be drawn; the message names the argument.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    dtype = _core.working_dtype(_core.resolve_backend(backend))
    random = np.random.default_rng([seed, 0xC047])
    weight, squared = np.zeros((2, len(splats)))
    for camera in cameras:
        picture = DifferentiableRender(splats, camera, random.uniform(size=3), backend)
        color = picture.image["color"]
        weight += picture.gradients(np.ones_like(color))["v_colors"][:, 0]
        # The square of a gradient for random signs is, on average, the sum of the squared gradients
        # of all pixels: the products of different pixels cancel.
        signs = random.choice(np.array([-1.0, 1.0], dtype), size=color.shape)
        v_opacities = picture.gradients(signs)["v_opacities"].astype(np.float64)
        squared += np.square(v_opacities * picture.projected["opacities"])
    return Contribution(weight, np.sqrt(squared))
