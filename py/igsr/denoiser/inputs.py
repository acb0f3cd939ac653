"""Input channels of the network: a render's buffers and the warped photos."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.denoiser.buffers import Buffers
from igsr.denoiser.warping import Warped

Float32 = npt.NDArray[np.float32]

#: Number of warped photos per pixel.
PHOTOS = 2
#: Channels of the color, which comes first, of further buffers, and of each photo.
COLOR = 3
BUFFERS = 8
PHOTO = 5
#: Alternatives to the render's color in a pixel: the photos' colors and the background's.
CHOICES = PHOTOS + 1
CHANNELS = COLOR + BUFFERS + CHOICES * PHOTO


def network_inputs(buffers: Buffers, warped: Warped) -> Float32:
    """Stack a render's buffers and the warped photos as the network's channels.

    The channels are: color, clamped to [0, 1]; alpha; ratio of the depth to the picture's median,
    minus one; relative depth deviation; normal; footprint; support; for each photo its color,
    validity and angle; and the same for the background, which the network may use to remove a
    floater in front of it. Buffers that are None are zero, like empty pixels.

    Returns:
        float32 [``CHANNELS``, H, W]; values are roughly in [0, 1].
    """
    height, width = buffers.color.shape[:2]
    out = np.zeros((CHANNELS, height, width), np.float32)
    color = np.nan_to_num(buffers.color, nan=0.0, posinf=1.0, neginf=0.0)
    out[:COLOR] = np.moveaxis(np.clip(color, 0.0, 1.0), -1, 0)
    for field, channel, normalize in (
        ("alpha", 3, lambda alpha: alpha),
        ("depth", 4, _relative_depth),
        ("depth_deviation", 5, lambda deviation: 4.0 * deviation),
        ("normal", slice(6, 9), lambda normal: np.moveaxis(normal, -1, 0)),
        ("footprint", 9, lambda footprint: footprint / 4.0),
        ("support", 10, lambda support: np.log2(1.0 + np.maximum(support, 0.0)) / 4.0),
    ):
        buffer = getattr(buffers, field)
        if buffer is not None:
            finite = np.nan_to_num(buffer, nan=0.0, posinf=0.0, neginf=0.0)
            out[channel] = np.clip(normalize(finite), -1.0, 2.0)
    for k in range(min(PHOTOS, len(warped.color))):
        first = COLOR + BUFFERS + k * PHOTO
        valid = warped.valid[k]
        out[first : first + 3] = np.moveaxis(warped.color[k], -1, 0) * valid
        out[first + 3] = valid
        out[first + 4] = np.where(valid, 1.0 - warped.angle[k] / np.pi, 0.0)
    if buffers.background is not None:
        first = COLOR + BUFFERS + PHOTOS * PHOTO
        out[first : first + 3] = np.clip(np.nan_to_num(buffers.background), 0, 1)[:, None, None]
        out[first + 3] = 1.0
    return out


def _relative_depth(depth: Float32) -> Float32:
    drawn = depth > 0.0
    if not drawn.any():
        return np.zeros_like(depth)
    ratio = depth / np.float32(np.median(depth[drawn])) - np.float32(1.0)
    return np.where(drawn, ratio, np.float32(0.0))
