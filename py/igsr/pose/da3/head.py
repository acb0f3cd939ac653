"""The head of Depth Anything 3: features of one view to depth, confidence and rays of its pixels.

A dense prediction transformer (Ranftl et al. 2021) with two chains over the same levels: one for
depth, one for rays (arXiv 2511.10647, section 3). Module names are those of the checkpoints' keys.
The head runs in float32 whatever the rest runs in, and for one view at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from igsr.pose.da3.backbone import ViewFeatures
from igsr.pose.da3.config import PATCH, NetworkConfig

#: Base of the frequencies that places are written in, and what they are multiplied by.
PLACE_BASE, PLACE_SIZE = 100.0, 0.1
#: Channels before the last convolution of each chain.
LAST_CHANNELS = 32
#: Direction and origin of a ray, and its confidence.
RAY_CHANNELS = 7
#: The level of the ray chain's outputs that is used; of the others only training has need.
RAY_LEVEL = 3
#: The published networks keep one norm for the outputs of all levels.
SHARED_NORM = "scratch.output_conv2_aux.{}.2"


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """What the head says of one view of H x W pixels.

    Attributes:
        depth: float32 [H, W], z-depth in the pass's own unit, positive.
        confidence: float32 [H, W], above 1.
        rays: float32 [8 gh, 8 gw, 6], direction (its z in the camera is 1) and origin in the
            world frame of the pass, at the pixel centres of that grid; None if not asked for.
        ray_confidence: float32 [8 gh, 8 gw], above 1; None if not asked for.
    """

    depth: Tensor
    confidence: Tensor
    rays: Tensor | None
    ray_confidence: Tensor | None


class DualHead(nn.Module):
    """Depth and rays of a view.

    Args:
        config: the sizes.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """Make the layers that are used; checkpoints have others besides."""
        super().__init__()
        dim, features = 2 * config.embed_dim, config.features
        fine, middle, _, coarsest = config.out_channels
        self.norm = nn.LayerNorm(dim)
        self.projects = nn.ModuleList(nn.Conv2d(dim, size, 1) for size in config.out_channels)
        # From a token's 14 pixels to a fourth, half, one and two of them.
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
            for chain in ("", "_aux"):
                self.scratch[f"refinenet{level}{chain}"] = _Fusion(features, level == 4)
        half = features // 2
        self.scratch["output_conv1"] = _conv3(features, half)
        self.scratch["output_conv2"] = nn.Sequential(
            _conv3(half, LAST_CHANNELS), nn.ReLU(), nn.Conv2d(LAST_CHANNELS, 2, 1)
        )
        # No activation stands between these five.
        ray_convs = nn.Sequential(
            *(_conv3(*((features, half) if n % 2 == 0 else (half, features))) for n in range(5))
        )
        ray_outputs = nn.Sequential(
            _conv3(half, LAST_CHANNELS),
            nn.Identity(),
            nn.LayerNorm(LAST_CHANNELS),
            nn.Identity(),
            nn.ReLU(),
            nn.Conv2d(LAST_CHANNELS, RAY_CHANNELS, 1),
        )
        # Named by their level, as if the others were there.
        self.scratch["output_conv1_aux"] = nn.ModuleDict({str(RAY_LEVEL): ray_convs})
        self.scratch["output_conv2_aux"] = nn.ModuleDict({str(RAY_LEVEL): ray_outputs})

    def forward(self, features: ViewFeatures, rays: bool) -> ViewMaps:
        """The maps of a view.

        Args:
            features: of the backbone.
            rays: whether rays are wanted, which take as long as depth.
        """
        levels = self.levels(features)
        height, width = PATCH * features.rows, PATCH * features.columns
        aspect = width / height
        maps = self.scratch["output_conv1"](self.joined(levels, ""))
        maps = _with_places(_resized(maps, (height, width)), aspect)
        channels = self.scratch["output_conv2"](maps)[0]
        depth, confidence = channels[0].exp(), 1.0 + channels[1].exp()
        if not rays:
            return ViewMaps(depth, confidence, None, None)
        maps = self.scratch.get_submodule(f"output_conv1_aux.{RAY_LEVEL}")(
            self.joined(levels, "_aux")
        )
        first, _, norm, _, relu, last = self.scratch.get_submodule(
            f"output_conv2_aux.{RAY_LEVEL}"
        ).children()
        maps = first(_with_places(maps, aspect))
        channels = last(relu(norm(maps.movedim(1, -1)).movedim(-1, 1)))[0]
        return ViewMaps(depth, confidence, channels[:6].movedim(0, -1), 1.0 + channels[6].exp())

    def levels(self, features: ViewFeatures) -> list[Tensor]:
        """The four levels [1, F, h, w] that both chains join, the finest first."""
        aspect = features.columns / features.rows
        levels = []
        for n, level in enumerate(features.levels):
            tokens = self.norm(level.float())
            image = tokens.mT.unflatten(-1, (features.rows, features.columns))[None]
            image = _with_places(self.projects[n](image), aspect)
            levels.append(self.scratch[f"layer{n + 1}_rn"](self.resize_layers[n](image)))
        return levels

    def joined(self, levels: list[Tensor], chain: str) -> Tensor:
        """Levels joined from the coarsest to the finest, [1, F, 8 gh, 8 gw].

        Args:
            levels: of ``levels``.
            chain: "" for depth, "_aux" for rays.
        """
        joined = None
        for n in (3, 2, 1, 0):
            height, width = levels[n].shape[-2:]
            size = levels[n - 1].shape[-2:] if n else (2 * height, 2 * width)
            joined = self.scratch[f"refinenet{n + 1}{chain}"](levels[n], joined, tuple(size))
        assert joined is not None
        return joined


class _Fusion(nn.Module):
    """A level joined with what the coarser levels gave, at the next level's resolution."""

    def __init__(self, features: int, coarsest: bool) -> None:
        super().__init__()
        if not coarsest:
            self.resConfUnit1 = _Residual(features)
        self.resConfUnit2 = _Residual(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, maps: Tensor, coarser: Tensor | None, size: tuple[int, int]) -> Tensor:
        if coarser is not None:
            maps = coarser + self.resConfUnit1(maps)
        # Published networks resize first. Both are linear and work on different axes, so either
        # order gives the same, and this one has fewer pixels to work on.
        return _resized(self.out_conv(self.resConfUnit2(maps)), size)


class _Residual(nn.Module):
    """Two convolutions, each after a ReLU, added to their input."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = _conv3(features, features), _conv3(features, features)

    def forward(self, maps: Tensor) -> Tensor:
        return maps + self.conv2(self.conv1(maps.relu()).relu_())


def _conv3(channels: int, out: int, bias: bool = True) -> nn.Conv2d:
    return nn.Conv2d(channels, out, 3, padding=1, bias=bias)


def _resized(maps: Tensor, size: tuple[int, int]) -> Tensor:
    return interpolate(maps, size=size, mode="bilinear", align_corners=True)


def _with_places(maps: Tensor, aspect: float) -> Tensor:
    """Maps [1, c, h, w] with the places of their pixels added to them, in place.

    Args:
        maps: c is a multiple of four.
        aspect: width over height of the network's input, in pixels.
    """
    channels, height, width = maps.shape[1:]
    diagonal = (aspect**2 + 1.0) ** 0.5
    quarter = channels // 4
    float64, device = torch.float64, maps.device
    turn = PLACE_BASE ** -(torch.arange(quarter, dtype=float64, device=device) / quarter)
    parts = []
    for size, extent in ((width, aspect / diagonal), (height, 1.0 / diagonal)):
        place = torch.linspace(-1.0, 1.0, size, dtype=float64, device=device)
        angles = place * (extent * (size - 1) / size) * turn[:, None]
        parts.append(PLACE_SIZE * torch.cat([angles.sin(), angles.cos()]).to(maps.dtype))
    across, down = parts
    # A copy of the largest maps takes as long as a convolution.
    maps[0, : 2 * quarter] += across[:, None, :]
    maps[0, 2 * quarter :] += down[:, :, None]
    return maps
