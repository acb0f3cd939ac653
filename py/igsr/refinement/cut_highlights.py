"""Highlights that photos cut to white, in photos whose exposures are taken out.

A cut channel tells that the scene is at least so bright. With a bright photo's exposure taken out
it would be grey, and tell that the sky is. The fit that found the exposures knows it as a lower
bound, and other photos showed it how bright the scene is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import View
from igsr.rendering.renders import render
from igsr.splats import Splats

#: The level of a channel that is cut.
CUT = 255


def with_cut_highlights(
    photos: Sequence[View],
    views: Sequence[View],
    splats: Splats,
    background: Sequence[float],
    backend: Backend = "auto",
) -> list[View]:
    """The photos, with cut channels at least as bright as the fit shows them.

    Args:
        photos: with their exposures taken out.
        views: the same, as they were taken, with their exposures (``View.exposure``) and cameras.
        splats: the fit that found the exposures.
        background: RGB in [0, 1], behind the render.
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
        cut &= view.image[..., 3:] == 255  # behind the others is a background of any color
    if not cut.any():
        return photo
    shown = render(splats, view.camera, background, backend).to_uint8()
    image = photo.image.copy()
    image[..., :3][cut] = np.maximum(image[..., :3], shown)[cut]
    return replace(photo, image=image)
