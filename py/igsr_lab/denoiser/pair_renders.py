"""Renders as the network sees them, beside the true pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from igsr._internal.choices import FitBackend
from igsr.capture import View
from igsr.denoiser.buffers import photo_support, render_buffers
from igsr.denoiser.inputs import PHOTOS, network_inputs
from igsr.denoiser.warping import photo_sources, warp_photos
from igsr.errors import IgsrError
from igsr.evaluation.scores import BLACK, over_background
from igsr.splats import Splats
from igsr_lab.denoiser.pair_files import Pairs, packed


def check_one_size(views: Sequence[View]) -> None:
    """Find before a fit what pairs of it could not hold.

    Raises:
        IgsrError: the views are not all of one size.
    """
    sizes = {(view.camera.width, view.camera.height) for view in views}
    if len(sizes) > 1:
        raise IgsrError(
            f"views to render are of sizes {sorted(sizes)}; pairs need one, resize the photos."
        )


def rendered_pairs(
    splats: Splats,
    photos: Sequence[View],
    views: Sequence[View],
    background: Sequence[float] | None,
    backend: FitBackend,
) -> Pairs:
    """What the network sees of each view, and the true pictures.

    ``background`` is what stands behind photos with alpha; None for photos without.

    Raises:
        IgsrError: the views are not all of one size.
    """
    check_one_size(views)
    support = photo_support(splats, photos, backend)
    behind = BLACK if background is None else background
    sources = photo_sources(splats, photos, behind, backend)
    inputs, truth, masks = [], [], []
    for view in views:
        buffers = render_buffers(splats, view.camera, support, background, backend)
        others = [s for s, photo in zip(sources, photos, strict=True) if photo.name != view.name]
        assert buffers.depth is not None
        assert buffers.alpha is not None
        warped = warp_photos(view.camera, buffers.depth, buffers.alpha, others, PHOTOS)
        inputs.append(packed(network_inputs(buffers, warped)))
        truth.append(np.moveaxis(over_background(view.image, behind), -1, 0))
        masks.append(np.ones(truth[-1].shape[1:], np.bool_) if view.mask is None else view.mask)
    return Pairs(np.stack(inputs), np.stack(truth), np.stack(masks))
