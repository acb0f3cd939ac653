"""Heads of DUSt3R: tokens of one photo to a point and a confidence per pixel.

Module names are those of the checkpoints' keys. Heads run in float32 whatever the rest runs in.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle

#: Pixels of a token's side.
PATCH = 16
#: Channels of a head's output: the point's direction and distance coded as a vector, confidence.
CHANNELS = 4
#: Channels of the DPT head's levels, the finest first.
LEVEL_CHANNELS = (96, 192, 384, 768)
#: Channels in which the DPT head joins its levels.
FEATURES = 256


@dataclass(frozen=True, eq=False)
class Tokens:
    """Tokens of a batch of photos of one shape.

    Attributes:
        features: [B, rows * columns, C], row by row.
        rows, columns: of the grid of tokens, ``PATCH`` pixels each.
    """

    features: Tensor
    rows: int
    columns: int

    @property
    def as_image(self) -> Tensor:
        """[B, C, rows, columns]."""
        return self.features.mT.unflatten(-1, (self.rows, self.columns))


@dataclass(frozen=True, eq=False)
class PointMaps:
    """Points of every pixel of a batch of photos.

    Attributes:
        points: float32 [B, H, W, 3], in the camera frame of the pair's first photo (OpenCV axes),
            in a unit of the pair's own.
        confidence: float32 [B, H, W], above 1.
    """

    points: Tensor
    confidence: Tensor


def point_maps(channels: Tensor) -> PointMaps:
    """The points that a head's output [B, 4, H, W] stands for.

    The first three are the point's direction times ln(1 + its distance), the last is
    ln(confidence - 1).
    """
    vector = channels[:, :3].permute(0, 2, 3, 1)
    distance = vector.norm(dim=-1, keepdim=True)
    points = vector / distance.clamp(min=1e-8) * torch.expm1(distance)
    return PointMaps(points, 1.0 + channels[:, 3].exp())


class LinearHead(nn.Module):
    """Each token's pixels from that token alone.

    Args:
        dim: channels of the tokens.
    """

    def __init__(self, dim: int) -> None:
        """Make the one layer."""
        super().__init__()
        self.proj = nn.Linear(dim, CHANNELS * PATCH**2)

    def forward(self, levels: list[Tokens]) -> Tensor:
        """[B, 4, H, W] from the last of the levels."""
        last = levels[-1]
        pixels = Tokens(self.proj(last.features), last.rows, last.columns)
        return pixel_shuffle(pixels.as_image, PATCH)


class DptHead(nn.Module):
    """The head of the dense prediction transformer (Ranftl et al. 2021): levels joined in turn.

    Args:
        dims: channels of the tokens of each of the four levels, the finest first.
    """

    def __init__(self, dims: tuple[int, int, int, int]) -> None:
        """Make the layers, which the checkpoints nest under the name ``dpt``."""
        super().__init__()
        self.dpt = _Dpt(dims)

    def forward(self, levels: list[Tokens]) -> Tensor:
        """[B, 4, H, W] from four levels of tokens."""
        return self.dpt(levels)


class _Dpt(nn.Module):
    def __init__(self, dims: tuple[int, int, int, int]) -> None:
        super().__init__()
        fine, middle, coarse, coarsest = LEVEL_CHANNELS
        # From a token's 16 pixels to strides of 4, 8, 16 and 32 pixels.
        self.act_postprocess = nn.ModuleList(
            [
                nn.Sequential(
                    nn.Conv2d(dims[0], fine, 1), nn.ConvTranspose2d(fine, fine, 4, stride=4)
                ),
                nn.Sequential(
                    nn.Conv2d(dims[1], middle, 1), nn.ConvTranspose2d(middle, middle, 2, stride=2)
                ),
                nn.Sequential(nn.Conv2d(dims[2], coarse, 1)),
                nn.Sequential(
                    nn.Conv2d(dims[3], coarsest, 1),
                    nn.Conv2d(coarsest, coarsest, 3, stride=2, padding=1),
                ),
            ]
        )
        self.scratch = nn.ModuleDict()
        for level, channels in enumerate(LEVEL_CHANNELS, start=1):
            reduced = nn.Conv2d(channels, FEATURES, 3, padding=1, bias=False)
            self.scratch[f"layer{level}_rn"] = reduced
            self.scratch[f"refinenet{level}"] = _Fusion()
        self.head = nn.Sequential(
            nn.Conv2d(FEATURES, FEATURES // 2, 3, padding=1),
            _Doubled(),
            nn.Conv2d(FEATURES // 2, FEATURES // 2, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(FEATURES // 2, CHANNELS, 1),
        )

    def forward(self, levels: list[Tokens]) -> Tensor:
        joined = None
        for level in (4, 3, 2, 1):
            reassembled = self.act_postprocess[level - 1](levels[level - 1].as_image)
            maps = self.scratch[f"layer{level}_rn"](reassembled)
            if joined is not None:
                # A coarsest level of an odd number of tokens is half a cell too large.
                joined = joined[..., : maps.shape[-2], : maps.shape[-1]]
            joined = self.scratch[f"refinenet{level}"](maps, joined)
        return self.head(joined)


class _Fusion(nn.Module):
    """A level joined with what the coarser levels gave, at twice the level's resolution."""

    def __init__(self) -> None:
        super().__init__()
        # The coarsest level leaves its first unit unused; checkpoints have weights for it all the
        # same.
        self.resConfUnit1 = _Residual()
        self.resConfUnit2 = _Residual()
        self.out_conv = nn.Conv2d(FEATURES, FEATURES, 1)

    def forward(self, maps: Tensor, coarser: Tensor | None) -> Tensor:
        if coarser is not None:
            maps = coarser + self.resConfUnit1(maps)
        return self.out_conv(_doubled(self.resConfUnit2(maps)))


class _Residual(nn.Module):
    """Two convolutions, each after a ReLU, added to their input."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(FEATURES, FEATURES, 3, padding=1)
        self.conv2 = nn.Conv2d(FEATURES, FEATURES, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        return maps + self.conv2(self.conv1(maps.relu()).relu_())


class _Doubled(nn.Module):
    """``_doubled`` as a layer, so that the layers after it have the numbers of the checkpoints."""

    def forward(self, maps: Tensor) -> Tensor:
        return _doubled(maps)


def _doubled(maps: Tensor) -> Tensor:
    return interpolate(maps, scale_factor=2, mode="bilinear", align_corners=True)
