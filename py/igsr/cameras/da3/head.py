"""The head of Depth Anything 3: depth and confidence of one view's pixels from its features.

A dense prediction transformer (Ranftl et al. 2021; arXiv 2511.10647, section 3), without the
published chain for rays. Module names are as in the checkpoints. The head always runs in float32,
and for one view at a time.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from igsr.cameras.da3.backbone import PATCH, NetworkConfig, ViewFeatures
from igsr.cameras.networks import ResidualConvs

#: Base of the frequencies of position embeddings, and their amplitude.
POSITION_BASE = 100.0
POSITION_AMPLITUDE = 0.1
#: Channels before the last convolution.
LAST_CHANNELS = 32


class DepthHead(nn.Module):
    """Predict the depth of a view."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        dim, features = 2 * config.embed_dim, config.features
        fine, middle, _, coarsest = config.out_channels
        self.norm = nn.LayerNorm(dim)
        self.projects = nn.ModuleList(nn.Conv2d(dim, size, 1) for size in config.out_channels)
        # From a token's 14 pixels to strides of a quarter, half, one and two tokens.
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(fine, fine, 4, stride=4),
                nn.ConvTranspose2d(middle, middle, 2, stride=2),
                nn.Identity(),
                nn.Conv2d(coarsest, coarsest, 3, stride=2, padding=1),
            ]
        )
        self.scratch = nn.ModuleDict()
        for level, channels in enumerate(config.out_channels, start=1):
            self.scratch[f"layer{level}_rn"] = _conv3(channels, features, bias=False)
            self.scratch[f"refinenet{level}"] = _Fusion(features, level == 4)
        half = features // 2
        self.scratch["output_conv1"] = _conv3(features, half)
        self.scratch["output_conv2"] = nn.Sequential(
            _conv3(half, LAST_CHANNELS), nn.ReLU(), nn.Conv2d(LAST_CHANNELS, 2, 1)
        )

    def forward(self, features: ViewFeatures) -> tuple[Tensor, Tensor]:
        """Predict a view's depth and confidence; see ``ViewPrediction``."""
        levels = self._levels(features)
        height, width = PATCH * features.rows, PATCH * features.columns
        aspect = width / height
        maps = self.scratch["output_conv1"](self._fused(levels))
        maps = _with_positions(_resized(maps, (height, width)), aspect)
        channels = self.scratch["output_conv2"](maps)[0]
        return channels[0].exp(), 1.0 + channels[1].exp()

    def _levels(self, features: ViewFeatures) -> list[Tensor]:
        """The four levels [1, F, h, w], the finest first."""
        aspect = features.columns / features.rows
        levels = []
        for n, level in enumerate(features.levels):
            tokens = self.norm(level.float())
            image = tokens.mT.unflatten(-1, (features.rows, features.columns))[None]
            image = _with_positions(self.projects[n](image), aspect)
            levels.append(self.scratch[f"layer{n + 1}_rn"](self.resize_layers[n](image)))
        return levels

    def _fused(self, levels: list[Tensor]) -> Tensor:
        """Fuse levels to [1, F, 8 gh, 8 gw]."""
        fused = None
        for n in (3, 2, 1, 0):
            height, width = levels[n].shape[-2:]
            size = levels[n - 1].shape[-2:] if n else (2 * height, 2 * width)
            fused = self.scratch[f"refinenet{n + 1}"](levels[n], fused, tuple(size))
        assert fused is not None
        return fused


class _Fusion(nn.Module):
    """Fuse a level with the coarser ones, at the next level's resolution."""

    def __init__(self, features: int, coarsest: bool) -> None:
        super().__init__()
        if not coarsest:
            self.resConfUnit1 = ResidualConvs(features)
        self.resConfUnit2 = ResidualConvs(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, maps: Tensor, coarser: Tensor | None, size: tuple[int, int]) -> Tensor:
        if coarser is not None:
            maps = coarser + self.resConfUnit1(maps)
        # Published networks resize first. Both are linear and act on different axes, so the order
        # does not matter, and this one has fewer pixels to process.
        return _resized(self.out_conv(self.resConfUnit2(maps)), size)


def _conv3(channels: int, out: int, bias: bool = True) -> nn.Conv2d:
    return nn.Conv2d(channels, out, 3, padding=1, bias=bias)


def _resized(maps: Tensor, size: tuple[int, int]) -> Tensor:
    return interpolate(maps, size=size, mode="bilinear", align_corners=True)


def _with_positions(maps: Tensor, aspect: float) -> Tensor:
    """Add position embeddings to maps [1, c, h, w] of an input of some width over height."""
    channels, height, width = maps.shape[1:]
    diagonal = (aspect**2 + 1.0) ** 0.5
    quarter = channels // 4
    float64, device = torch.float64, maps.device
    frequencies = POSITION_BASE ** -(torch.arange(quarter, dtype=float64, device=device) / quarter)
    parts = []
    for size, extent in ((width, aspect / diagonal), (height, 1.0 / diagonal)):
        position = torch.linspace(-1.0, 1.0, size, dtype=float64, device=device)
        angles = position * (extent * (size - 1) / size) * frequencies[:, None]
        parts.append(POSITION_AMPLITUDE * torch.cat([angles.sin(), angles.cos()]).to(maps.dtype))
    across, down = parts
    # In place: a copy of the largest maps takes as long as a convolution.
    maps[0, : 2 * quarter] += across[:, None, :]
    maps[0, 2 * quarter :] += down[:, :, None]
    return maps
