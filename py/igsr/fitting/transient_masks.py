"""Masks of transient objects in a fit: when to look for them, and how checkpoints keep them.

A fit is a function of its state and its views. Where masks change, it continues with a new fitter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.choices import Backend
from igsr.capture import Camera, PseudoView, View
from igsr.fitting.fitter import fitted_cameras, fitted_exposures, without_exposures
from igsr.fitting.settings import FitSettings
from igsr.floaters.photo_evidence import behind_masks
from igsr.splats import Splats
from igsr.transients import EVIDENT_FRACTION, find_transients

Bool = npt.NDArray[np.bool_]
#: For each view, bool [H, W], True for pixels that show transient objects; None if none do.
Masks: TypeAlias = list[Bool | None]

#: Fractions of the steps after which transient objects are searched for.
LOOK_FRACTIONS = (0.3, 0.5, 0.7)
#: Keys in checkpoints: the masks as packed bits, and the step of the last look.
MASKS_KEY = "transient_masks"
LOOKED_KEY = "transients_looked"
#: Two photos must see what a third shows alone.
MIN_PHOTOS = 3


def steps_to_look(settings: FitSettings, views: Sequence[View]) -> tuple[int, ...]:
    """Steps after which transient objects are searched for.

    "auto" is off for photos with alpha, which show a cut-out object only.
    """
    photos = [view for view in views if not isinstance(view, PseudoView)]
    has_alpha = any(view.image.shape[2] == 4 for view in photos)
    is_off = settings.transients == "auto" and has_alpha
    if settings.transients == "off" or is_off or len(photos) < MIN_PHOTOS:
        return ()
    first, last = settings.first_step, settings.steps
    return tuple(sorted({first + round(part * (last - first)) for part in LOOK_FRACTIONS}))


def look_for_transients(
    fitter: _core.Fitter,
    views: Sequence[View],
    origin: npt.NDArray[np.float64],
    masks: Masks,
    settings: FitSettings,
    backend: Backend,
) -> Masks:
    """Search for transient objects by the splats so far; return the new masks."""
    splats = Splats(**fitter.splats(), origin=origin, antialiased=False)
    cameras = fitted_cameras(views, fitter, origin)
    moved = [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]
    moved = without_exposures(moved, fitted_exposures(views, fitter))
    must_be_evident = settings.transients == "auto" and not any_masked(masks)
    return find_transients(
        splats,
        moved,
        masks,
        min_evident=EVIDENT_FRACTION if must_be_evident else 0.0,
        background=settings.background or (0.0, 0.0, 0.0),
        backend=backend,
    )


def visible_splats(
    splats: Splats, cameras: Sequence[Camera], masks: Masks, frozen: int, backend: Backend
) -> Bool:
    """Splats [N] that unmasked pixels show; nothing would correct the others.

    The last ``frozen`` splats are always kept, and so are all if no other would remain.
    """
    keep: Bool = ~behind_masks(splats, cameras, masks, backend)
    keep[len(keep) - frozen :] = True
    return keep if keep[: len(keep) - frozen].any() else np.ones_like(keep)


def any_masked(masks: Masks) -> bool:
    """Whether any view has masked pixels."""
    return any(mask is not None for mask in masks)


def masked_view(view: View, mask: Bool | None) -> View:
    """The view without the masked pixels."""
    if mask is None:
        return view
    return replace(view, mask=~mask if view.mask is None else view.mask & ~mask)


def masked_views(views: Sequence[View], masks: Masks) -> list[View]:
    """The views without their masked pixels."""
    return [masked_view(view, mask) for view, mask in zip(views, masks, strict=True)]


def masked_fractions(names: Sequence[str], masks: Masks) -> dict[str, float]:
    """Masked fraction of each photo that has masked pixels, by name."""
    pairs = zip(names, masks, strict=True)
    return {name: float(mask.mean()) for name, mask in pairs if mask is not None}


def mask_arrays(views: Sequence[View], masks: Masks, looked_at: int) -> dict[str, Any]:
    """The arrays that checkpoints keep.

    Args:
        views: of the fit.
        masks: of the views.
        looked_at: step of the last look; -1 before the first.
    """
    looked = {} if looked_at < 0 else {LOOKED_KEY: np.array([looked_at], np.int64)}
    if not any_masked(masks):
        return looked
    bits = [
        np.zeros((view.camera.height, view.camera.width), np.bool_) if mask is None else mask
        for view, mask in zip(views, masks, strict=True)
    ]
    packed = np.packbits(np.concatenate([plane.reshape(-1) for plane in bits]))
    return {**looked, MASKS_KEY: packed}


def masks_from_arrays(
    views: Sequence[View], state: dict[str, npt.NDArray[Any]]
) -> tuple[Masks, int]:
    """Remove ``mask_arrays`` from a checkpoint's state; return the masks and the last look.

    Raises:
        ValueError: the arrays do not fit the views.
    """
    bits, looked = state.pop(MASKS_KEY, None), state.pop(LOOKED_KEY, np.array([-1], np.int64))
    if looked.dtype != np.int64 or looked.shape != (1,) or looked[0] < -1:
        raise ValueError(f"{LOOKED_KEY}: must be a step")
    if bits is None:
        return [None] * len(views), int(looked[0])
    sizes = [view.camera.width * view.camera.height for view in views]
    if bits.dtype != np.uint8 or bits.shape != (-(-sum(sizes) // 8),):
        raise ValueError(f"{MASKS_KEY}: must have a bit for each pixel of {len(views)} views")
    planes = np.split(np.unpackbits(bits, count=sum(sizes)).astype(np.bool_), np.cumsum(sizes)[:-1])
    masks: Masks = []
    for view, plane in zip(views, planes, strict=True):
        masks.append(plane.reshape(view.camera.height, view.camera.width) if plane.any() else None)
    return masks, int(looked[0])
