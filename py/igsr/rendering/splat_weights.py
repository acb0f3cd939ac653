"""Weights of splats in a picture: how much each one contributes to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Camera
from igsr.rendering.renders import project
from igsr.splats import Splats

Array = npt.NDArray[Any]


class DifferentiableRender:
    """A render of splats over a background, and the gradients of its colors.

    Attributes:
        projected: 2D splats, from ``_core.project``.
        image: pictures, from ``_core.rasterize``.
    """

    def __init__(
        self, splats: Splats, camera: Camera, background: Sequence[float] | Array, backend: str
    ) -> None:
        self._backend = _core.resolve_backend(backend)
        self._background = np.asarray(background, _core.working_dtype(self._backend))
        self.projected = project(splats, camera, self._backend)
        self.image: dict[str, Array] = _core.rasterize(
            self.projected,
            width=camera.width,
            height=camera.height,
            background=self._background,
            backend=self._backend,
        )

    def gradients(self, v_color: Array) -> dict[str, Array]:
        """Compute the gradients of the 2D splats for ``v_color`` [H, W, 3].

        That in "v_colors" [N, 3] is the sum of a splat's blending weights times ``v_color``.
        """
        zero = np.zeros_like(self.image["alpha"])
        return _core.rasterize_backward(
            self.projected,
            self.image,
            v_color=v_color,
            v_alpha=zero,
            v_depth=zero,
            background=self._background,
            absolute=False,
            backend=self._backend,
        )


def splat_weights(
    splats: Splats,
    camera: Camera,
    backend: str = "auto",
    mask: npt.NDArray[np.bool_] | None = None,
) -> Array:
    """Sum the blending weights of each splat over a picture: its visible area in pixels, [N].

    ``mask`` is bool [H, W], True for pixels that count; None counts all.
    """
    picture = DifferentiableRender(splats, camera, np.zeros(3), backend)
    v_color = np.ones_like(picture.image["color"])
    if mask is not None:
        v_color *= mask[..., None]
    weights: Array = picture.gradients(v_color)["v_colors"][:, 0]
    return weights
