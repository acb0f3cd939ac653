"""``igsr.denoise``: a cleaner picture of a render, and a confidence for each pixel."""

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
from igsr.denoiser.network import REACH_PX, DenoiserNetwork
from igsr.denoiser.warping import Source, Warped, warp_photos
from igsr.denoiser.weights import load_network
from igsr.errors import IgsrError
from igsr.rendering.renders import Render

Float32 = npt.NDArray[np.float32]

#: A change this many times as large as the expected error is halved, since it may be wrong.
#: On scenes unlike the training scenes, uncertain changes do harm.
DOUBT = 1.0
#: Smaller changes of all channels are not visible and not made; a correct background stays exact.
MIN_CHANGE = 1.5 / 255.0
#: Side of the tiles that large pictures are processed in, to limit memory.
TILE_PX = 768
assert TILE_PX % MULTIPLE == 0
assert REACH_PX % MULTIPLE == 0


class Denoiser(Protocol):
    """Interface of functions that denoise renders; see ``denoise``."""

    def __call__(
        self, render: Buffers, photos: Sequence[Source]
    ) -> tuple[Float32, Float32] | Float32:
        """Denoise one render.

        Args:
            render: the color and other buffers of the render.
            photos: the photos to look up colors in.

        Returns:
            The picture, float32 [H, W, 3] in [0, 1], and the confidence, float32 [H, W] in [0, 1].
            Or only the picture: ``denoise`` then derives the confidence from the changes.
        """


class NetworkDenoiser:
    """A denoiser with a network trained by igsr.

    Args:
        network: the network, from ``load_network``.
        doubt: a change this many times as large as the expected error is halved. 0 makes all
            changes in full, for callers that weight the picture by its confidence.
    """

    def __init__(self, network: DenoiserNetwork, doubt: float = DOUBT) -> None:
        self.network, self.doubt = network, doubt

    def __call__(self, render: Buffers, photos: Sequence[Source]) -> tuple[Float32, Float32]:
        """Denoise one render; see ``denoise``."""
        picture, confidence = self.clean(network_inputs(render, _warped(render, photos)))
        # Pixels that are not finite are invented, not cleaned.
        broken = ~np.isfinite(render.color).all(axis=-1)
        return picture, np.where(broken, np.float32(0.0), confidence)

    def clean(self, inputs: Float32) -> tuple[Float32, Float32]:
        """Denoise the output of ``network_inputs``; returns the same as ``denoise``.

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
        visible = change.abs().amax(dim=0) >= MIN_CHANGE
        cleaned = torch.where(visible, render + change, render)
        picture = cleaned.clamp(0.0, 1.0).permute(1, 2, 0).contiguous().numpy()
        error: Float32 = expected.numpy()
        return picture, confidence_of(error)

    def _in_tiles(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        height, width = inputs.shape[-2:]
        image = torch.empty(1, 3, height, width)
        log_error = torch.empty(1, 1, height, width)
        with torch.inference_mode():
            for top in range(0, height, TILE_PX):
                for left in range(0, width, TILE_PX):
                    above, before = min(top, REACH_PX), min(left, REACH_PX)
                    rows = slice(top - above, top + TILE_PX + REACH_PX)
                    columns = slice(left - before, left + TILE_PX + REACH_PX)
                    tile = inputs[..., rows, columns].contiguous(memory_format=torch.channels_last)
                    inner = (..., slice(above, above + TILE_PX), slice(before, before + TILE_PX))
                    outer = (..., slice(top, top + TILE_PX), slice(left, left + TILE_PX))
                    picture, error = self.network(tile)
                    image[outer], log_error[outer] = picture[inner], error[inner]
        return image, log_error


def denoise(
    render: Buffers | Render | npt.NDArray[Any],
    photos: Sequence[Source] = (),
    denoiser: Denoiser | None = None,
) -> tuple[Float32, Float32]:
    """Denoise a render of a scene that was fitted to too few photos.

    Args:
        render: of any size: from ``igsr.denoiser.render_buffers`` (best) or ``igsr.render``, or a
            picture [H, W, 3], sRGB, uint8 or float in [0, 1]. More buffers allow more repairs.
        photos: from ``igsr.denoiser.photo_sources``; requires a render from ``render_buffers``,
            which has a camera.
        denoiser: None is the denoiser that comes with igsr.

    Returns:
        The picture, float32 [H, W, 3] in [0, 1], and the confidence, float32 [H, W] in [0, 1].
        The confidence is 0.05 / (0.05 + expected absolute error of the colors); it is 0.5 for an
        expected error of 5 % of the range. NaN pixels are filled in and have confidence 0.

    Raises:
        IgsrError: an argument has another type, shape or dtype, ``photos`` are given for a render
            without a camera, ``denoiser`` returns arrays of another size, or the shipped weights
            cannot be read.
    """
    unusable = [type(photo).__name__ for photo in photos if not isinstance(photo, Source)]
    if unusable:
        raise IgsrError(f"photos must be of igsr.denoiser.photo_sources, not {unusable[0]}")
    if photos and not isinstance(render, Buffers):
        raise IgsrError(
            "photos need a render with a camera: give one of igsr.denoiser.render_buffers, or no "
            "photos"
        )
    buffers = _buffers(render)
    result = (denoiser or _shipped())(buffers, photos)
    picture, confidence = result if isinstance(result, tuple) else (result, None)
    size = buffers.color.shape[:2]
    if picture.shape != (*size, 3) or (confidence is not None and confidence.shape != size):
        also = "" if confidence is None else f" and a confidence {list(confidence.shape)}"
        raise IgsrError(
            f"the denoiser returned a picture {list(picture.shape)}{also} for a render of "
            f"{list(size)} pixels"
        )
    if confidence is None:
        confidence = confidence_of(claimed_by_change(buffers.color, picture))
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
        shape = (PHOTOS, *render.color.shape[:2])
        return Warped(
            np.zeros((*shape, 3), np.float32),
            np.zeros(shape, np.bool_),
            np.full(shape, np.pi, np.float32),
        )
    depth = np.nan_to_num(render.depth, nan=0.0, posinf=0.0, neginf=0.0)
    alpha = np.nan_to_num(render.alpha, nan=0.0, posinf=0.0, neginf=0.0)
    return warp_photos(render.camera, depth, alpha, photos, PHOTOS)
