"""The network of DUSt3R: a ViT encoder, two decoders that attend to each other, a head for each.

Wang et al., CVPR 2024, section 3.1; the blocks are those of CroCo v2 (Weinzaepfel et al., ICCV
2023) with rotary position embeddings of rows and columns (Su et al. 2021). Module names are those
of the checkpoints' keys.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from igsr.errors import IgsrError
from igsr.pose.dust3r.heads import PATCH, DptHead, LinearHead, PointMaps, Tokens, point_maps
from igsr.pose.transformer_layers import Mlp, Rotation, rotary_tables, rotated

NORM_EPS = 1e-6
#: Largest size that a configuration may have: what a damaged file claims must not be built.
MOST_DIM, MOST_BLOCKS, MOST_IMAGE_SIZE = 4096, 64, 2048


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of a network; the defaults are the published 512-pixel model with the DPT head.

    Attributes:
        image_size: pixels of a photo's longer side; 224 stands for square photos.
        head: "dpt" or "linear".
        encoder_dim, encoder_depth, encoder_heads: channels, blocks and attention heads.
        decoder_dim, decoder_depth, decoder_heads: of each of the two decoders.

    Raises:
        IgsrError: a size is no whole number, out of bounds or does not divide into heads.
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
        """Check the sizes."""
        if self.head not in ("dpt", "linear"):
            raise IgsrError(f"head is {self.head!r}; a DUSt3R network has 'dpt' or 'linear'")
        for name, least, most in (
            ("image_size", PATCH, MOST_IMAGE_SIZE),
            ("encoder_dim", 4, MOST_DIM),
            ("encoder_depth", 1, MOST_BLOCKS),
            ("encoder_heads", 1, MOST_DIM),
            ("decoder_dim", 4, MOST_DIM),
            ("decoder_depth", 2, MOST_BLOCKS),
            ("decoder_heads", 1, MOST_DIM),
        ):
            value = getattr(self, name)
            if type(value) is not int or not least <= value <= most:
                raise IgsrError(f"{name} is {value!r}; give a whole number from {least} to {most}")
        for part in ("encoder", "decoder"):
            dim, heads = getattr(self, f"{part}_dim"), getattr(self, f"{part}_heads")
            # Two axes, and two numbers turned together in each.
            if dim % (4 * heads):
                raise IgsrError(
                    f"{part}_dim is {dim} and {part}_heads is {heads}; give a multiple of four "
                    "channels to each head"
                )

    @property
    def levels(self) -> tuple[int, ...]:
        """What the heads are given: 0 is the encoder's output, n that of the decoder's block n."""
        depth = self.decoder_depth
        return (0, depth * 2 // 4, depth * 3 // 4, depth) if self.head == "dpt" else (depth,)


class Dust3rNetwork(nn.Module):
    """Points of two photos from their pixels.

    Args:
        config: the sizes.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """Make the layers, with random weights."""
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
        """What the encoder makes of photos of one shape, each on its own.

        Args:
            images: [B, 3, H, W] in [-1, 1]; H and W multiples of 16.
        """
        patches = self.patch_embed["proj"](images)
        rows, columns = patches.shape[-2:]
        rotation = self._rotation("encoder", rows, columns, images.device)
        # The sums that the blocks add to stay in float32, whatever the blocks compute in.
        features = patches.flatten(2).mT.float()
        for block in self.enc_blocks:
            features = block(features, rotation)
        return Tokens(self.enc_norm(features), rows, columns)

    def decode(self, first: Tokens, second: Tokens) -> tuple[PointMaps, PointMaps]:
        """The points of pairs of encoded photos, all in the camera frames of the first ones.

        Args:
            first, second: B photos each; the shapes of first and second may differ.

        Returns:
            The maps of the first and of the second photos.
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
        return rotary_tables(places_of(rows, columns, device), dim // heads)


def places_of(rows: int, columns: int, device: torch.device) -> Tensor:
    """Row and column [rows * columns, 2] of each token."""
    return torch.cartesian_prod(
        torch.arange(rows, device=device), torch.arange(columns, device=device)
    )


def _norm(dim: int) -> nn.LayerNorm:
    return nn.LayerNorm(dim, eps=NORM_EPS)


def _decoder(config: NetworkConfig) -> nn.ModuleList:
    return nn.ModuleList(
        _DecoderBlock(config.decoder_dim, config.decoder_heads) for _ in range(config.decoder_depth)
    )


def _head(config: NetworkConfig) -> nn.Module:
    if config.head == "linear":
        return LinearHead(config.decoder_dim)
    dim = config.decoder_dim
    return DptHead((config.encoder_dim, dim, dim, dim))


def _maps(head: nn.Module, levels: list[Tensor], tokens: Tokens) -> PointMaps:
    """A head's maps from the levels of photos of the shape of ``tokens``."""
    return point_maps(
        head([Tokens(level.float(), tokens.rows, tokens.columns) for level in levels])
    )


def _per_head(x: Tensor, heads: int) -> Tensor:
    """[B, T, C] as [B, heads, T, C / heads]."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def _attended(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Values [B, heads, S, D] gathered by queries [B, heads, T, D], as [B, T, heads * D]."""
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
        """``x`` after it has looked at ``y``, the other photo's tokens of the same layer."""
        x = x + self.attn(self.norm1(x), rotation_x)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(y), rotation_x, rotation_y)
        return x + self.mlp(self.norm3(x))
