"""``igsr.denoise``: a cleaner picture from a render, and a confidence for each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr.denoiser.architecture import MULTIPLE
from igsr.denoiser.buffers import Buffers
from igsr.denoiser.confidence import claimed_by_change, confidence_of
from igsr.denoiser.inputs import COLOR, PHOTOS, network_inputs
from igsr.denoiser.network import REACH, DenoiserNetwork
from igsr.denoiser.warping import Source, Warped, warp_photos
from igsr.denoiser.weights import load_network
from igsr.errors import IgsrError
from igsr.rendering.renders import Render

Float32 = npt.NDArray[np.float32]

#: Only half of a change is made if it is this many times as large as the error that is expected to
#: remain: it is as likely wrong. On scenes unlike those of the training, unsure changes go wrong.
DOUBT = 1.0
#: Colours that would change by less than this, in units of their range, are left alone: nobody sees
#: it, and a background that is right stays exactly so.
SMALLEST_CHANGE = 1.5 / 255.0
#: Larger pictures go through the network in tiles of this side, pixels, which limits memory.
TILE = 768
assert TILE % MULTIPLE == 0
assert REACH % MULTIPLE == 0


class Denoiser(Protocol):
    """Anything that denoises renders; see ``denoise``."""

    def __call__(
        self, render: Buffers, photos: Sequence[Source]
    ) -> tuple[Float32, Float32] | Float32:
        """Denoise one render.

        Args:
            render: the colours and what the rasterizer knows of them.
            photos: the photos to look colours up in.

        Returns:
            The picture, float32 [H, W, 3] in [0, 1], and the confidence, float32 [H, W] in [0, 1].
            Or the picture alone: ``denoise`` then trusts it the less, the more it changes.
        """


class NetworkDenoiser:
    """A denoiser with a network, such as igsr trains.

    Args:
        network: its network, ready for use (``load_network``).
        doubt: only half of a change is made if it is this many times as large as the error that
            is expected to remain. 0 makes every change in full, for callers that weight the picture
            by its confidence.
    """

    def __init__(self, network: DenoiserNetwork, doubt: float = DOUBT) -> None:
        """Keep the network."""
        self.network, self.doubt = network, doubt

    def __call__(self, render: Buffers, photos: Sequence[Source]) -> tuple[Float32, Float32]:
        """Clean one render; see ``denoise``."""
        picture, confidence = self.clean(network_inputs(render, _warped(render, photos)))
        # A picture that was not finite has been guessed, not cleaned.
        broken = ~np.isfinite(render.color).all(axis=-1)
        return picture, np.where(broken, np.float32(0.0), confidence)

    def clean(self, inputs: Float32) -> tuple[Float32, Float32]:
        """Clean what ``network_inputs`` gave, [``CHANNELS``, H, W]; returns as ``denoise``.

        Args:
            inputs: float32 [``CHANNELS``, H, W].
        """
        image, log_error = self._in_tiles(torch.from_numpy(inputs)[None])
        render = torch.from_numpy(inputs[:COLOR])
        expected = log_error[0, 0].exp()
        change = image[0] - render
        squared = change.abs().amax(dim=0).square()
        both = squared + (self.doubt * expected).square()
        change *= squared / both.clamp_min(torch.finfo(both.dtype).tiny)
        seen = change.abs().amax(dim=0) >= SMALLEST_CHANGE
        cleaned = torch.where(seen, render + change, render)
        picture = cleaned.clamp(0.0, 1.0).permute(1, 2, 0).contiguous().numpy()
        error: Float32 = expected.numpy()
        return picture, confidence_of(error)

    def _in_tiles(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        height, width = inputs.shape[-2:]
        image = torch.empty(1, 3, height, width)
        log_error = torch.empty(1, 1, height, width)
        with torch.inference_mode():
            for top in range(0, height, TILE):
                for left in range(0, width, TILE):
                    above, before = min(top, REACH), min(left, REACH)
                    rows = slice(top - above, top + TILE + REACH)
                    columns = slice(left - before, left + TILE + REACH)
                    tile = inputs[..., rows, columns].contiguous(memory_format=torch.channels_last)
                    inner = (..., slice(above, above + TILE), slice(before, before + TILE))
                    at = (..., slice(top, top + TILE), slice(left, left + TILE))
                    picture, error = self.network(tile)
                    image[at], log_error[at] = picture[inner], error[inner]
        return image, log_error


def denoise(
    render: Buffers | Render | npt.NDArray[Any],
    photos: Sequence[Source] = (),
    denoiser: Denoiser | None = None,
) -> tuple[Float32, Float32]:
    """Denoise a render of a scene that was fitted from too few photos.

    Args:
        render: of any size: what ``igsr.denoiser.render_buffers`` (best) or ``igsr.render`` gave,
            or only a picture [H, W, 3], sRGB, uint8 or float in [0, 1]. The more the render knows
            beside its colours, the more the denoiser can repair.
        photos: what ``igsr.denoiser.photo_sources`` gave; only with a render of ``render_buffers``,
            since others have no camera.
        denoiser: what denoises; None is the denoiser that comes with igsr.

    Returns:
        The picture, float32 [H, W, 3] in [0, 1], and the confidence, float32 [H, W] in [0, 1].
        The confidence is 0.05 / (0.05 + expected absolute error of the colours): a half where
        colours are expected to be off by a twentieth of their range. NaN pixels are filled in and
        have confidence 0.

    Raises:
        IgsrError: an array has another shape or dtype, photos are of another kind or could not be
            used, ``denoiser`` returns arrays of another size, or the shipped weights cannot be
            read.
    """
    others = [type(photo).__name__ for photo in photos if not isinstance(photo, Source)]
    if others:
        raise IgsrError(f"photos must be of igsr.denoiser.photo_sources, not {others[0]}")
    if photos and not isinstance(render, Buffers):
        raise IgsrError(
            "photos can be looked up only where render has a camera: give one of "
            "igsr.denoiser.render_buffers, or no photos"
        )
    given = _buffers(render)
    made = (denoiser or _shipped())(given, photos)
    if isinstance(made, tuple):
        picture, confidence = made
    else:
        picture, confidence = made, None
    size = given.color.shape[:2]
    if picture.shape != (*size, 3) or (confidence is not None and confidence.shape != size):
        raise IgsrError(
            f"the denoiser made a picture {list(picture.shape)}"
            + ("" if confidence is None else f" and a confidence {list(confidence.shape)}")
            + f" of a render of {list(size)} pixels"
        )
    if confidence is None:
        confidence = confidence_of(claimed_by_change(given.color, picture))
    return picture, confidence


@cache
def _shipped() -> NetworkDenoiser:
    return NetworkDenoiser(load_network())


def _buffers(render: Buffers | Render | npt.NDArray[Any]) -> Buffers:
    if isinstance(render, Buffers):
        return render
    if isinstance(render, Render):
        return Buffers(color=render.color, alpha=render.alpha, depth=render.expected_depth)
    picture = np.asarray(render)
    if picture.dtype == np.uint8:
        return Buffers(color=picture.astype(np.float32) / np.float32(255.0))
    if not np.issubdtype(picture.dtype, np.floating):
        raise IgsrError(f"render must be uint8 or float [H, W, 3], not {picture.dtype}")
    return Buffers(color=picture.astype(np.float32))


def _warped(render: Buffers, photos: Sequence[Source]) -> Warped:
    if render.camera is None or render.depth is None or render.alpha is None:
        height, width = render.color.shape[:2]
        nothing = np.zeros((PHOTOS, height, width), np.bool_)
        return Warped(
            np.zeros((*nothing.shape, 3), np.float32),
            nothing,
            np.full(nothing.shape, np.pi, np.float32),
        )
    depth = np.nan_to_num(render.depth, nan=0.0, posinf=0.0, neginf=0.0)
    alpha = np.nan_to_num(render.alpha, nan=0.0, posinf=0.0, neginf=0.0)
    return warp_photos(render.camera, depth, alpha, photos, PHOTOS)
