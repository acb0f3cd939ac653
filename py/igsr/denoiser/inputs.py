"""The input channels of the network, made from a render's buffers and the warped photos."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.denoiser.buffers import Buffers
from igsr.denoiser.warping import Warped

Float32 = npt.NDArray[np.float32]

#: Photos per pixel.
PHOTOS = 2
#: Channels by where they come from; the colour always comes first.
COLOR, BUFFERS = 3, 8
PHOTO = 5
#: Colours that a pixel may have beside the render's: the photos' and the background's.
CHOICES = PHOTOS + 1
CHANNELS = COLOR + BUFFERS + CHOICES * PHOTO


def network_inputs(buffers: Buffers, warped: Warped) -> Float32:
    """One render as the network's channels, float32 [``CHANNELS``, H, W], all about 0 to 1 in size.

    Colour, clamped to [0, 1]; alpha; depth as its ratio to the picture's median, less one; its
    relative deviation; the normal; the footprint; the support; for each photo its colour, whether
    it is valid, and its angle; and likewise the background: a floater before it is removed by
    taking its colour, whatever that is. What ``buffers`` lacks (None) is zero, as where nothing is
    drawn.
    """
    height, width = buffers.color.shape[:2]
    out = np.zeros((CHANNELS, height, width), np.float32)
    color = np.nan_to_num(buffers.color, nan=0.0, posinf=1.0, neginf=0.0)
    out[:COLOR] = np.moveaxis(np.clip(color, 0.0, 1.0), -1, 0)
    for field, channel, normalise in (
        ("alpha", 3, lambda alpha: alpha),
        ("depth", 4, _relative_depth),
        ("depth_deviation", 5, lambda deviation: 4.0 * deviation),
        ("normal", slice(6, 9), lambda normal: np.moveaxis(normal, -1, 0)),
        ("footprint", 9, lambda footprint: footprint / 4.0),
        ("support", 10, lambda support: np.log2(1.0 + np.maximum(support, 0.0)) / 4.0),
    ):
        given = getattr(buffers, field)
        if given is not None:
            finite = np.nan_to_num(given, nan=0.0, posinf=0.0, neginf=0.0)
            out[channel] = np.clip(normalise(finite), -1.0, 2.0)
    for k in range(min(PHOTOS, len(warped.color))):
        at = COLOR + BUFFERS + k * PHOTO
        valid = warped.valid[k]
        out[at : at + 3] = np.moveaxis(warped.color[k], -1, 0) * valid
        out[at + 3] = valid
        out[at + 4] = np.where(valid, 1.0 - warped.angle[k] / np.pi, 0.0)
    if buffers.background is not None:
        at = COLOR + BUFFERS + PHOTOS * PHOTO
        out[at : at + 3] = np.clip(np.nan_to_num(buffers.background), 0.0, 1.0)[:, None, None]
        out[at + 3] = 1.0
    return out


def _relative_depth(depth: Float32) -> Float32:
    drawn = depth > 0.0
    if not drawn.any():
        return np.zeros_like(depth)
    ratio = depth / np.float32(np.median(depth[drawn])) - np.float32(1.0)
    return np.where(drawn, ratio, np.float32(0.0))
