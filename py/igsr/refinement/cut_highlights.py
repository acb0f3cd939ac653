"""Clipped highlights of photos whose exposures are removed.

A clipped channel is a lower bound of the brightness. Removing the exposure of a bright photo would
turn a white sky gray. The fit that estimated the exposures has the brightness from other photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import View
from igsr.rendering.renders import render
from igsr.splats import Splats

#: Value of a clipped channel.
CUT = 255


def with_cut_highlights(
    photos: Sequence[View],
    views: Sequence[View],
    splats: Splats,
    background: Sequence[float],
    backend: Backend = "auto",
) -> list[View]:
    """Raise clipped channels of photos to the brightness of the fit.

    Args:
        photos: with their exposures removed.
        views: the original photos with their exposures (``View.exposure``) and cameras.
        splats: the fit that estimated the exposures.
        background: RGB in [0, 1] behind the render.
        backend: "auto", "cpu", "gpu" or "reference".
    """
    return [
        photo if view.exposure is None else _lifted(photo, view, splats, background, backend)
        for photo, view in zip(photos, views, strict=True)
    ]


def _lifted(
    photo: View, view: View, splats: Splats, background: Sequence[float], backend: Backend
) -> View:
    cut = view.image[..., :3] == CUT
    if view.image.shape[2] == 4:
        cut &= view.image[..., 3:] == 255  # other pixels show a random background
    if not cut.any():
        return photo
    shown = render(splats, view.camera, background, backend).to_uint8()
    image = photo.image.copy()
    image[..., :3][cut] = np.maximum(image[..., :3], shown)[cut]
    return replace(photo, image=image)
