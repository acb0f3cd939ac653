"""Evidence of photos for and against each splat: visibility, depth and need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Camera, PseudoView, View
from igsr.evaluation.scores import over_background
from igsr.rendering.splat_weights import DifferentiableRender
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

BLACK = (0.0, 0.0, 0.0)
#: A photo shows a splat whose visible area is at least this, pixels.
MIN_AREA_PX = 0.5
#: A splat is in front of the surface if its depth is less than this fraction of the surface's.
FRONT_DEPTH_RATIO = 2.0 / 3.0
#: A splat is masked in a photo if at least this fraction of its area there is masked.
MIN_MASKED_FRACTION = 0.2
#: Random probes of each photo; their mean estimates a splat's squared change.
PROBES_PER_PHOTO = 4


@dataclass(frozen=True, eq=False)
class Sightings:
    """Visibility of each splat in some cameras. All [N].

    Attributes:
        area: visible area, summed over cameras, pixels.
        counted: the part of ``area`` in pixels that count.
        shown: number of cameras that show the splat.
        before: number of these cameras in which it is in front of the surface.
    """

    area: Float64
    counted: Float64
    shown: Int64
    before: Int64


def sightings(
    splats: Splats,
    cameras: Sequence[Camera],
    backend: str = "auto",
    masks: Sequence[Bool | None] | None = None,
) -> Sightings:
    """Count the cameras that see each splat, and how often it is in front of the surface.

    The surface is the mean expected depth of the splat's pixels.

    Args:
        splats: the scene.
        cameras: of the photos.
        backend: "auto", "cpu", "gpu" or "reference".
        masks: bool [H, W] for each camera, True for pixels that count; None if all count.
    """
    area, counted = np.zeros((2, len(splats)))
    shown, before = np.zeros((2, len(splats)), np.int64)
    for camera, mask in zip(cameras, masks or [None] * len(cameras), strict=True):
        picture = DifferentiableRender(splats, camera, BLACK, backend)
        alpha = picture.image["alpha"]
        surface = picture.image["depth"] / np.maximum(alpha, np.finfo(alpha.dtype).tiny)
        ones = np.ones_like(alpha)
        counting = ones if mask is None else mask.astype(alpha.dtype)
        # Weights times 1 sum up to the area, times the depth to the area times the mean depth.
        v = picture.gradients(np.stack([ones, surface, counting], axis=-1))["v_colors"]
        covered = v[:, 0].astype(np.float64)
        is_shown = covered >= MIN_AREA_PX
        area += covered
        counted += v[:, 2]
        shown += is_shown
        before += is_shown & (picture.projected["depths"] * covered < FRONT_DEPTH_RATIO * v[:, 1])
    return Sightings(area, counted, shown, before)


def behind_masks(
    splats: Splats,
    cameras: Sequence[Camera],
    masked: Sequence[Bool | None],
    backend: str = "auto",
) -> Bool:
    """Find splats that one photo shows in masked pixels and other photos show less of.

    Such a splat, close to a camera, was fitted to pixels that are masked now; nothing corrects it.

    Args:
        splats: the scene.
        cameras: of the photos.
        masked: bool [H, W] of each photo, True for masked pixels; None if none is.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        bool [N]: True if at least ``MIN_MASKED_FRACTION`` of the splat's area in a photo is masked,
        and the unmasked area in all other photos together is smaller than that.
    """
    total = np.zeros(len(splats))
    areas = []  # only of photos with masks, since there may be thousands without
    for camera, hidden in zip(cameras, masked, strict=True):
        picture = DifferentiableRender(splats, camera, BLACK, backend)
        ones = np.ones_like(picture.image["alpha"])
        inside = np.zeros_like(ones) if hidden is None else hidden.astype(ones.dtype)
        v_color = np.stack([ones - inside, inside, np.zeros_like(ones)], axis=-1)
        v_colors = picture.gradients(v_color)["v_colors"]
        open_area, masked_area = v_colors[:, :2].astype(np.float64).T
        total += open_area
        if hidden is not None:
            areas.append((open_area, masked_area))
    result = np.zeros(len(splats), np.bool_)
    for open_area, masked_area in areas:
        is_masked = masked_area >= MIN_MASKED_FRACTION * (masked_area + open_area)
        result |= (masked_area > 0.0) & is_masked & (total - open_area < masked_area)
    return result


def needed_by_others(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    seed: int = 0,
    backend: str = "auto",
) -> Float64:
    """Estimate how much the photos' squared error grows without a splat, [N].

    The photo whose error grows most is left out: a splat that only one photo needs was made up for
    it, since all other photos show empty space there. So the result is at most 0 if no other photo
    needs the splat, and 0 if at most one photo shows it.

    A render is linear in the opacity ``o`` of one splat, up to the clamp at 0.99. Removing the
    splat changes the color C by ``-o dC/do`` and the squared error E by
    ``sum((o dC/do)^2) - o dE/do``. The first sum is estimated with random signs (Hutchinson 1989),
    the second term is exact.

    Args:
        splats: the scene.
        views: photos and cameras; masked pixels do not count.
        background: RGB in [0, 1] behind renders and photos with alpha, for views without their own.
        seed: of the random signs.
        backend: "auto", "cpu", "gpu" or "reference".
    """
    dtype = _core.working_dtype(_core.resolve_backend(backend))
    random = np.random.default_rng([seed, 0xF10A])
    total, largest = np.zeros(len(splats)), np.full(len(splats), -np.inf)
    for view in views:
        own = view.background if isinstance(view, PseudoView) else None
        behind = background if own is None else own
        picture = DifferentiableRender(splats, view.camera, behind, backend)
        opacities = picture.projected["opacities"].astype(np.float64)
        photo = over_background(view.image, behind).astype(dtype) / dtype(255.0)
        residual = picture.image["color"] - photo
        counts = np.ones_like(residual)
        if view.mask is not None:
            counts *= view.mask[..., None]
        growth = -opacities * picture.gradients(2.0 * counts * residual)["v_opacities"]
        for _ in range(PROBES_PER_PHOTO):
            signs = counts * random.choice(np.array([-1.0, 1.0], dtype), size=counts.shape)
            change = opacities * picture.gradients(signs)["v_opacities"]
            growth += np.square(change) / PROBES_PER_PHOTO
        total += growth
        largest = np.maximum(largest, growth)
    return total - largest if views else total
