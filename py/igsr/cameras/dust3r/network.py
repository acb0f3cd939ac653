"""The network of DUSt3R: a ViT encoder, two decoders that attend to each other, a head for each.

Wang et al., CVPR 2024, section 3.1. The blocks come from CroCo v2 (Weinzaepfel et al., ICCV
2023), the DPT head from Ranftl et al. 2021. Module names are as in the checkpoints.
The heads run in float32 even if the rest runs in half precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle, scaled_dot_product_attention

from igsr.cameras.networks import Mlp, ResidualConvs, Rotation, rotary_tables, rotated
from igsr.errors import IgsrError

#: Pixels along a token's side.
PATCH = 16
#: Channels of a head's output: a vector for the point, and the confidence.
HEAD_CHANNELS = 4
#: Channels of the DPT head's levels, the finest first.
LEVEL_CHANNELS = (96, 192, 384, 768)
#: Channels in which the DPT head fuses its levels.
FEATURES = 256
NORM_EPS = 1e-6
#: Upper bounds of the sizes in a config, so that a damaged file cannot exhaust memory.
MAX_DIM = 4096
MAX_BLOCKS = 64
MAX_IMAGE_SIZE = 2048


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of a network; the defaults are the published 512-pixel model with the DPT head.

    Attributes:
        image_size: pixels of a photo's longer side; 224 means square photos.
        head: "dpt" or "linear".
        encoder_dim, encoder_depth, encoder_heads: channels, blocks and attention heads.
        decoder_dim, decoder_depth, decoder_heads: of each of the two decoders.

    Raises:
        IgsrError: a size is not an integer, is out of bounds, or does not divide into heads.
    """

    image_size: int = 512
    head: str = "dpt"
    encoder_dim: int = 1024
    encoder_depth: int = 24
    encoder_heads: int = 16
    decoder_dim: int = 768
    decoder_depth: int = 12
    decoder_heads: int = 12

    def __post_init__(self) -> None:
        if self.head not in ("dpt", "linear"):
            raise IgsrError(f"head is {self.head!r}; a DUSt3R network has 'dpt' or 'linear'")
        for name, low, high in (
            ("image_size", PATCH, MAX_IMAGE_SIZE),
            ("encoder_dim", 4, MAX_DIM),
            ("encoder_depth", 1, MAX_BLOCKS),
            ("encoder_heads", 1, MAX_DIM),
            ("decoder_dim", 4, MAX_DIM),
            ("decoder_depth", 2, MAX_BLOCKS),
            ("decoder_heads", 1, MAX_DIM),
        ):
            value = getattr(self, name)
            if type(value) is not int or not low <= value <= high:
                raise IgsrError(f"{name} is {value!r}; give a whole number from {low} to {high}")
        for part in ("encoder", "decoder"):
            dim, heads = getattr(self, f"{part}_dim"), getattr(self, f"{part}_heads")
            # Rotary embeddings rotate pairs of channels, by row and by column.
            if dim % (4 * heads):
                raise IgsrError(
                    f"{part}_dim is {dim} and {part}_heads is {heads}; give a multiple of four "
                    "channels to each head"
                )

    @property
    def levels(self) -> tuple[int, ...]:
        """Inputs of the heads: 0 is the output of the encoder, n of block n of the decoder."""
        depth = self.decoder_depth
        return (0, depth * 2 // 4, depth * 3 // 4, depth) if self.head == "dpt" else (depth,)


@dataclass(frozen=True, eq=False)
class Tokens:
    """Tokens of a batch of photos of one shape."""

    features: Tensor  # [B, rows * columns, C], row by row
    rows: int
    columns: int

    @property
    def as_image(self) -> Tensor:
        """[B, C, rows, columns]."""
        return self.features.mT.unflatten(-1, (self.rows, self.columns))


@dataclass(frozen=True, eq=False)
class PointMaps:
    """A point for every pixel of a batch of photos, in an arbitrary unit per pair."""

    points: Tensor  # float32 [B, H, W, 3], in the camera frame of the pair's first photo
    confidence: Tensor  # float32 [B, H, W], above 1


class Dust3rNetwork(nn.Module):
    """Predict the points of two photos."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        patches = nn.Conv2d(3, config.encoder_dim, PATCH, stride=PATCH)
        self.patch_embed = nn.ModuleDict({"proj": patches})
        self.enc_blocks = nn.ModuleList(
            _EncoderBlock(config.encoder_dim, config.encoder_heads)
            for _ in range(config.encoder_depth)
        )
        self.enc_norm = _norm(config.encoder_dim)
        self.decoder_embed = nn.Linear(config.encoder_dim, config.decoder_dim)
        self.dec_blocks, self.dec_blocks2 = _decoder(config), _decoder(config)
        self.dec_norm = _norm(config.decoder_dim)
        self.downstream_head1, self.downstream_head2 = _head(config), _head(config)

    def encode(self, images: Tensor) -> Tokens:
        """Encode photos [B, 3, H, W] in [-1, 1]; H and W are multiples of 16."""
        patches = self.patch_embed["proj"](images)
        rows, columns = patches.shape[-2:]
        rotation = self._rotation("encoder", rows, columns, images.device)
        # Residual sums stay in float32, even if the blocks run in half precision.
        features = patches.flatten(2).mT.float()
        for block in self.enc_blocks:
            features = block(features, rotation)
        return Tokens(self.enc_norm(features), rows, columns)

    def decode(self, first: Tokens, second: Tokens) -> tuple[PointMaps, PointMaps]:
        """Predict maps of B first and of B second photos, in the camera frames of the first ones.

        The shapes of the first and of the second photos may differ.
        """
        device = first.features.device
        rotations = [self._rotation("decoder", t.rows, t.columns, device) for t in (first, second)]
        one, two = (self.decoder_embed(tokens.features).float() for tokens in (first, second))
        levels = {0: (first.features, second.features)}
        for n, (block1, block2) in enumerate(
            zip(self.dec_blocks, self.dec_blocks2, strict=True), start=1
        ):
            one, two = (
                block1(one, two, rotations[0], rotations[1]),
                block2(two, one, rotations[1], rotations[0]),
            )
            if n in self.config.levels:
                levels[n] = (one, two)
        levels[self.config.decoder_depth] = (self.dec_norm(one), self.dec_norm(two))
        # Points span orders of magnitude, which half precision and TF32 would round visibly.
        with (
            torch.autocast(device.type, enabled=False),
            torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False),
        ):
            return (
                _maps(self.downstream_head1, [levels[n][0] for n in self.config.levels], first),
                _maps(self.downstream_head2, [levels[n][1] for n in self.config.levels], second),
            )

    def _rotation(self, part: str, rows: int, columns: int, device: torch.device) -> Rotation:
        dim, heads = getattr(self.config, f"{part}_dim"), getattr(self.config, f"{part}_heads")
        positions = torch.cartesian_prod(
            torch.arange(rows, device=device), torch.arange(columns, device=device)
        )
        return rotary_tables(positions, dim // heads)


def _norm(dim: int) -> nn.LayerNorm:
    return nn.LayerNorm(dim, eps=NORM_EPS)


def _decoder(config: NetworkConfig) -> nn.ModuleList:
    return nn.ModuleList(
        _DecoderBlock(config.decoder_dim, config.decoder_heads) for _ in range(config.decoder_depth)
    )


def _head(config: NetworkConfig) -> nn.Module:
    dim = config.decoder_dim
    if config.head == "linear":
        return _LinearHead(dim)
    return _DptHead((config.encoder_dim, dim, dim, dim))


def _maps(head: nn.Module, levels: Sequence[Tensor], tokens: Tokens) -> PointMaps:
    """Apply a head to levels of photos of the shape of ``tokens``."""
    channels = head([Tokens(level.float(), tokens.rows, tokens.columns) for level in levels])
    # The first three channels are the point's direction times ln(1 + its distance), the last is
    # ln(confidence - 1).
    vector = channels[:, :3].permute(0, 2, 3, 1)
    distance = vector.norm(dim=-1, keepdim=True)
    points = vector / distance.clamp(min=1e-8) * torch.expm1(distance)
    return PointMaps(points, 1.0 + channels[:, 3].exp())


def _per_head(x: Tensor, heads: int) -> Tensor:
    """[B, T, C] as [B, heads, T, C / heads]."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def _attended(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Attention of queries [B, heads, T, D], as [B, T, heads * D]."""
    return scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(-2)


class _SelfAttention(nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, rotation: Rotation) -> Tensor:
        q, k, v = (_per_head(part, self.heads) for part in self.qkv(x).chunk(3, dim=-1))
        return self.proj(_attended(rotated(q, rotation), rotated(k, rotation), v))


class _CrossAttention(nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq = nn.Linear(dim, dim)
        self.projk = nn.Linear(dim, dim)
        self.projv = nn.Linear(dim, dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, y: Tensor, rotation_x: Rotation, rotation_y: Rotation) -> Tensor:
        q = rotated(_per_head(self.projq(x), self.heads), rotation_x)
        k = rotated(_per_head(self.projk(y), self.heads), rotation_y)
        return self.proj(_attended(q, k, _per_head(self.projv(y), self.heads)))


class _EncoderBlock(nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.norm1 = _norm(dim)
        self.attn = _SelfAttention(dim, heads)
        self.norm2 = _norm(dim)
        self.mlp = Mlp(dim)

    def forward(self, x: Tensor, rotation: Rotation) -> Tensor:
        x = x + self.attn(self.norm1(x), rotation)
        return x + self.mlp(self.norm2(x))


class _DecoderBlock(nn.Module):
    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.norm1 = _norm(dim)
        self.attn = _SelfAttention(dim, heads)
        self.norm2 = _norm(dim)
        self.norm_y = _norm(dim)
        self.cross_attn = _CrossAttention(dim, heads)
        self.norm3 = _norm(dim)
        self.mlp = Mlp(dim)

    def forward(self, x: Tensor, y: Tensor, rotation_x: Rotation, rotation_y: Rotation) -> Tensor:
        """Update ``x``; ``y`` are the other photo's tokens of the same layer."""
        x = x + self.attn(self.norm1(x), rotation_x)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(y), rotation_x, rotation_y)
        return x + self.mlp(self.norm3(x))


class _LinearHead(nn.Module):
    """Compute each token's pixels from that token alone."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.proj = nn.Linear(dim, HEAD_CHANNELS * PATCH**2)

    def forward(self, levels: Sequence[Tokens]) -> Tensor:
        """[B, 4, H, W] from the last level."""
        last = levels[-1]
        pixels = Tokens(self.proj(last.features), last.rows, last.columns)
        return pixel_shuffle(pixels.as_image, PATCH)


class _DptHead(nn.Module):
    """Fuse four levels of tokens, from the coarsest to the finest."""

    def __init__(self, dims: Sequence[int]) -> None:
        super().__init__()
        fine, middle, coarse, coarsest = LEVEL_CHANNELS
        # From a token's 16 pixels to strides of 4, 8, 16 and 32 pixels.
        reassemble = nn.ModuleList(
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
        scratch = nn.ModuleDict()
        for level, channels in enumerate(LEVEL_CHANNELS, start=1):
            reduced = nn.Conv2d(channels, FEATURES, 3, padding=1, bias=False)
            scratch[f"layer{level}_rn"] = reduced
            scratch[f"refinenet{level}"] = _Fusion()
        head = nn.Sequential(
            nn.Conv2d(FEATURES, FEATURES // 2, 3, padding=1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(FEATURES // 2, FEATURES // 2, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(FEATURES // 2, HEAD_CHANNELS, 1),
        )
        self.dpt = nn.ModuleDict({"act_postprocess": reassemble, "scratch": scratch, "head": head})

    def forward(self, levels: Sequence[Tokens]) -> Tensor:
        """[B, 4, H, W]."""
        layer, fused = self.dpt.get_submodule, None
        for level in (4, 3, 2, 1):
            reassembled = layer(f"act_postprocess.{level - 1}")(levels[level - 1].as_image)
            maps = layer(f"scratch.layer{level}_rn")(reassembled)
            if fused is not None:
                # A coarsest level of an odd number of tokens is half a cell too large.
                fused = fused[..., : maps.shape[-2], : maps.shape[-1]]
            fused = layer(f"scratch.refinenet{level}")(maps, fused)
        return layer("head")(fused)


class _Fusion(nn.Module):
    """Fuse a level with the coarser ones, at twice the level's resolution."""

    def __init__(self) -> None:
        super().__init__()
        # The coarsest level does not use its first unit; checkpoints still have weights for it.
        self.resConfUnit1 = ResidualConvs(FEATURES)
        self.resConfUnit2 = ResidualConvs(FEATURES)
        self.out_conv = nn.Conv2d(FEATURES, FEATURES, 1)

    def forward(self, maps: Tensor, coarser: Tensor | None) -> Tensor:
        if coarser is not None:
            maps = coarser + self.resConfUnit1(maps)
        doubled = interpolate(
            self.resConfUnit2(maps), scale_factor=2, mode="bilinear", align_corners=True
        )
        return self.out_conv(doubled)
