"""The network: a small U-Net that predicts a correction of a render and the remaining error.

Its blocks are NAFNet's (Chen et al. 2022: depthwise convolutions, gates instead of activations)
without pooling over the whole picture. An output depends only on pixels within ``REACH_PX``, so
large pictures can be processed in tiles.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from igsr.denoiser.architecture import MULTIPLE, Architecture
from igsr.denoiser.inputs import BUFFERS, CHANNELS, CHOICES, COLOR, PHOTO

#: Receptive field in each direction, pixels; a multiple of ``MULTIPLE``.
REACH_PX = 96
#: Bounds of the predicted logarithm of the error; colors range from 0 to 1.
MIN_LOG_ERROR = -7.0
MAX_LOG_ERROR = 0.0
#: Predicted logarithm of the error before training: about a twentieth of the range.
INITIAL_LOG_ERROR = -3.0
#: Initial scale of the residual branches. NAFNet starts at 0, which costs hundreds of steps.
INITIAL_SCALE = 0.3
#: Epsilon of the layer norms.
NORM_EPSILON = 1e-6
#: Initial logit of a warped photo; the render's is 0.
INITIAL_LOGIT = -2.0


def _gate(x: Tensor) -> Tensor:
    first, second = x.chunk(2, dim=-1)
    return first * second


class _Block(nn.Module):
    """NAFNet's block.

    Pointwise layers are linear over the last dimension: a third faster than 1x1 convolutions when
    channels are last in memory.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels, eps=NORM_EPSILON)
        self.expand1 = nn.Linear(channels, 2 * channels)
        self.depthwise = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1, groups=2 * channels)
        self.project1 = nn.Linear(channels, channels)
        self.norm2 = nn.LayerNorm(channels, eps=NORM_EPSILON)
        self.expand2 = nn.Linear(channels, 2 * channels)
        self.project2 = nn.Linear(channels, channels)
        self.scale1 = nn.Parameter(torch.full((channels,), INITIAL_SCALE))
        self.scale2 = nn.Parameter(torch.full((channels,), INITIAL_SCALE))

    def forward(self, x: Tensor) -> Tensor:
        x = x.permute(0, 2, 3, 1)
        inner = self.expand1(self.norm1(x)).permute(0, 3, 1, 2)
        inner = _gate(self.depthwise(inner).permute(0, 2, 3, 1))
        x = x + self.project1(inner) * self.scale1
        inner = _gate(self.expand2(self.norm2(x)))
        x = x + self.project2(inner) * self.scale2
        return x.permute(0, 3, 1, 2)


class DenoiserNetwork(nn.Module):
    """Predict a picture and the logarithm of its expected error from ``network_inputs``.

    Args:
        architecture: settings; None is the default.
        dropout: fraction of the features at the lowest resolution to drop in training.
    """

    def __init__(self, architecture: Architecture | None = None, dropout: float = 0.0) -> None:
        super().__init__()
        self.architecture = architecture or Architecture()
        width, (half, quarter, eighth) = self.architecture.width, self.architecture.blocks
        self.head = nn.Conv2d(4 * CHANNELS, width, 3, padding=1)
        self.down_half = nn.Sequential(*(_Block(width) for _ in range(half)))
        self.to_quarter = nn.Conv2d(width, 2 * width, 2, stride=2)
        self.down_quarter = nn.Sequential(*(_Block(2 * width) for _ in range(quarter)))
        self.to_eighth = nn.Conv2d(2 * width, 4 * width, 2, stride=2)
        self.middle = nn.Sequential(*(_Block(4 * width) for _ in range(eighth)))
        self.dropout = nn.Dropout2d(dropout)
        self.from_eighth = nn.Conv2d(4 * width, 8 * width, 1)
        self.up_quarter = nn.Sequential(*(_Block(2 * width) for _ in range(quarter)))
        self.from_quarter = nn.Conv2d(2 * width, 4 * width, 1)
        self.up_half = nn.Sequential(*(_Block(width) for _ in range(half)))
        self.tail = nn.Conv2d(width, 4 * (COLOR + 1 + CHOICES), 3, padding=1)
        # An untrained network returns nearly the render.
        for parameter in self.tail.parameters():
            nn.init.zeros_(parameter)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Denoise.

        Args:
            inputs: [B, ``CHANNELS``, H, W] of any size, from ``network_inputs``.

        Returns:
            The picture [B, 3, H, W], not clamped, and the natural logarithm of the expected
            absolute error of its colors [B, 1, H, W].
        """
        if inputs.shape[1] != CHANNELS:
            raise ValueError(f"inputs must have {CHANNELS} channels, not {inputs.shape[1]}")
        height, width = inputs.shape[-2:]
        padding = (0, -width % MULTIPLE, 0, -height % MULTIPLE)
        x = F.pad(inputs, padding, mode="replicate")
        half = self.down_half(self.head(F.pixel_unshuffle(x, 2)))
        quarter = self.down_quarter(self.to_quarter(half))
        eighth = self.dropout(self.middle(self.to_eighth(quarter)))
        quarter = self.up_quarter(quarter + F.pixel_shuffle(self.from_eighth(eighth), 2))
        half = self.up_half(half + F.pixel_shuffle(self.from_quarter(quarter), 2))
        out = F.pixel_shuffle(self.tail(half), 2)[..., :height, :width]
        image = out[:, :COLOR] + _mixed(inputs, out[:, COLOR + 1 :] + INITIAL_LOGIT)
        log_error = out[:, COLOR : COLOR + 1] + INITIAL_LOG_ERROR
        return image, log_error.clamp(MIN_LOG_ERROR, MAX_LOG_ERROR)


def _mixed(inputs: Tensor, logits: Tensor) -> Tensor:
    """Mean colors [B, 3, H, W] of the render, with logit 0, and of the valid photos."""
    photos = inputs[:, COLOR + BUFFERS :].unflatten(1, (CHOICES, PHOTO))
    logits = logits.masked_fill(photos[:, :, COLOR] < 0.5, -torch.inf)
    weights = F.pad(logits, (0, 0, 0, 0, 1, 0)).softmax(dim=1)
    colors = torch.cat([inputs[:, None, :COLOR], photos[:, :, :COLOR]], dim=1)
    return (weights[:, :, None] * colors).sum(dim=1)
