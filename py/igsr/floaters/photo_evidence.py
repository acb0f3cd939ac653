"""What photos say about each splat: whether they show it, where it stands, who needs it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Camera, PseudoView, View
from igsr.evaluation.scores import over_background
from igsr.rendering.renders import project
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: A photo shows a splat that covers at least so much of it, in pixels.
SHOWN = 0.5
#: A splat stands before the surface if its depth is below this part of the surface's.
BEFORE = 2.0 / 3.0
#: Part of what a photo shows of a splat that must be masked for the splat to be of what is there.
MASKED = 0.2
#: Random probes of each photo; their mean estimates a splat's squared change.
PROBES = 4


@dataclass(frozen=True, eq=False)
class Sightings:
    """Where cameras see each splat. All [N].

    Attributes:
        area: blending weight summed over pixels and cameras: the area in pixels that the splat
            covers, as far as nothing before it hides it.
        counted: the part of that area in pixels that count.
        shown: number of cameras that show it.
        before: number of those where it stands before the surface that its pixels show.
    """

    area: Float64
    counted: Float64
    shown: Int64
    before: Int64


class _Picture:
    """A camera's render, and gradients of it."""

    def __init__(
        self, splats: Splats, camera: Camera, background: npt.NDArray[Any], backend: str
    ) -> None:
        self._background, self._backend = background, backend
        self.projected = project(splats, camera, backend)
        self.image = _core.rasterize(
            self.projected,
            width=camera.width,
            height=camera.height,
            background=background,
            backend=backend,
        )

    def backward(self, v_color: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
        """Gradients of the 2D splats for that of the picture's color, [H, W, 3]."""
        nothing = np.zeros_like(self.image["alpha"])
        return _core.rasterize_backward(
            self.projected,
            self.image,
            v_color=v_color,
            v_alpha=nothing,
            v_depth=nothing,
            background=self._background,
            absolute=False,
            backend=self._backend,
        )


def sightings(
    splats: Splats,
    cameras: Sequence[Camera],
    backend: str = "auto",
    masks: Sequence[npt.NDArray[np.bool_] | None] | None = None,
) -> Sightings:
    """Count who shows each splat, and who shows it before the surface.

    The surface of a pixel is its expected depth; a splat's is the mean of its pixels' by its weight
    in them.

    Args:
        splats: the scene.
        cameras: of the photos.
        backend: "auto", "cpu", "gpu" or "reference".
        masks: bool [H, W] for each camera, True for pixels that count; None where all do.

    Raises:
        ValueError: the parameters cannot be drawn; the message names the argument.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    backend = _core.resolve_backend(backend)
    dtype = _core.working_dtype(backend)
    area, counted = np.zeros((2, len(splats)))
    shown, before = np.zeros((2, len(splats)), np.int64)
    for camera, mask in zip(cameras, masks or [None] * len(cameras), strict=True):
        picture = _Picture(splats, camera, np.zeros(3, dtype), backend)
        alpha = picture.image["alpha"]
        surface = picture.image["depth"] / np.maximum(alpha, np.finfo(dtype).tiny)
        # The gradient for a splat's color is the sum of its weights with the picture's gradient: of
        # ones it is the area, of the surface's depth the area times the mean depth, and of ones
        # where pixels count the area that does.
        ones = np.ones_like(alpha)
        counting = ones if mask is None else mask.astype(dtype)
        v = picture.backward(np.stack([ones, surface, counting], axis=-1))["v_colors"]
        covered = v[:, 0].astype(np.float64)
        is_shown = covered >= SHOWN
        area += covered
        counted += v[:, 2]
        shown += is_shown
        before += is_shown & (picture.projected["depths"] * covered < BEFORE * v[:, 1])
    return Sightings(area, counted, shown, before)


def behind_masks(
    splats: Splats,
    cameras: Sequence[Camera],
    masked: Sequence[npt.NDArray[np.bool_] | None],
    backend: str = "auto",
) -> npt.NDArray[np.bool_]:
    """Which splats one photo shows in masked pixels, and the other photos show less of.

    Such a splat, close before a camera, is made up for what was masked later; nothing corrects it.

    Args:
        splats: the scene.
        cameras: of the photos.
        masked: bool [H, W] of each, True where it is masked; None where nothing is.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        bool [N]: true where a photo has at least ``MASKED`` of what it shows of the splat in masked
        pixels, and all others together show less than that in pixels that are not masked.

    Raises:
        ValueError: the parameters cannot be drawn; the message names the argument.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    backend = _core.resolve_backend(backend)
    dtype = _core.working_dtype(backend)
    total = np.zeros(len(splats))
    areas = []  # of photos with masks alone: there may be thousands without
    for camera, hidden in zip(cameras, masked, strict=True):
        picture = _Picture(splats, camera, np.zeros(3, dtype), backend)
        ones = np.ones((camera.height, camera.width), dtype)
        inside = np.zeros_like(ones) if hidden is None else hidden.astype(dtype)
        v = picture.backward(np.stack([ones - inside, inside, np.zeros_like(ones)], axis=-1))
        open_area, masked_area = v["v_colors"][:, :2].astype(np.float64).T
        total += open_area
        if hidden is not None:
            areas.append((open_area, masked_area))
    found = np.zeros(len(splats), np.bool_)
    for open_area, masked_area in areas:
        made_up = (masked_area > 0.0) & (masked_area >= MASKED * (masked_area + open_area))
        found |= made_up & (total - open_area < masked_area)
    return found


def needed_by_others(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    seed: int = 0,
    backend: str = "auto",
) -> Float64:
    """How much the photos' squared error grows without a splat, but for that which needs it most.

    A splat that only one photo needs is made up for it: the others show that nothing is there. A
    render is linear in the opacity ``o`` of one splat, but for the clamp at 0.99. So removing it
    changes the color C by ``-o dC/do`` and the squared error E by ``sum((o dC/do)^2) - o dE/do``.
    The first sum is estimated with random signs (Hutchinson 1989), the second term is exact.

    Args:
        splats: the scene.
        views: photos and cameras; masked pixels do not count.
        background: RGB in [0, 1], behind renders and behind photos with alpha; a view's own comes
            first.
        seed: of the random signs.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        float64 [N], summed over pixels and channels (colors of 1); 0 or below: the other photos do
        not need the splat. 0 where at most one photo shows it.

    Raises:
        ValueError: the parameters cannot be drawn; the message names the argument.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    backend = _core.resolve_backend(backend)
    dtype = _core.working_dtype(backend)
    random = np.random.default_rng([seed, 0xF10A])
    total, most = np.zeros(len(splats)), np.full(len(splats), -np.inf)
    for view in views:
        own = view.background if isinstance(view, PseudoView) else None
        behind = background if own is None else own
        picture = _Picture(splats, view.camera, np.asarray(behind, dtype), backend)
        opacities = picture.projected["opacities"].astype(np.float64)
        photo = over_background(view.image, behind).astype(dtype) / dtype(255.0)
        residual = picture.image["color"] - photo
        counts = np.ones_like(residual)
        if view.mask is not None:
            counts *= view.mask[..., None]
        grown = -opacities * picture.backward(2.0 * counts * residual)["v_opacities"]
        for _ in range(PROBES):
            signs = counts * random.choice(np.array([-1.0, 1.0], dtype), size=counts.shape)
            grown += np.square(opacities * picture.backward(signs)["v_opacities"]) / PROBES
        total += grown
        most = np.maximum(most, grown)
    return total - most if views else total
