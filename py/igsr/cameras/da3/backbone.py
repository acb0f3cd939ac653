"""The backbone of Depth Anything 3: a DINOv2 transformer with blocks that attend to all views.

Depth Anything 3 (arXiv 2511.10647), section 3; DINOv2 (Oquab et al. 2023). Module names are as
in the checkpoints. Views are a list of token arrays, so that they may differ in size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention

from igsr.cameras.networks import Mlp, Rotation, rotary_tables, rotated

#: Pixels along a token's side.
PATCH = 14
#: Tokens along a side of the stored position embedding, which is for photos of 518 pixels.
POSITIONS = 37
#: Number of blocks.
DEPTH = 12
#: First block with rotary positions, normalized queries and keys, and the camera token. From there
#: on every second block attends to all views.
FIRST_GLOBAL = 4
#: Blocks whose output goes to the head and the camera decoder.
OUTPUT_BLOCKS = (5, 7, 9, 11)
#: Block before which the reference view is chosen.
CHOICE_BLOCK = FIRST_GLOBAL - 1
#: Minimum number of views to choose from; of fewer the first is the reference.
MIN_VIEWS_TO_CHOOSE = 3
#: Epsilon of the norms before attention and MLP; all others have torch's default of 1e-5.
BLOCK_NORM_EPS = 1e-6
#: Offset of the scale factors by which DINOv2 resamples the position embedding.
RESAMPLING_OFFSET = 0.1


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of a network."""

    embed_dim: int  # channels of the backbone
    heads: int  # attention heads of the backbone
    features: int  # channels in which the head fuses its levels
    out_channels: tuple[int, int, int, int]  # channels of the head's levels, the finest first


SMALL = NetworkConfig(embed_dim=384, heads=6, features=64, out_channels=(48, 96, 192, 384))
BASE = NetworkConfig(embed_dim=768, heads=12, features=128, out_channels=(96, 192, 384, 768))


class Block(nn.Module):
    """Attention, then an MLP, each scaled per channel and added to its input."""

    def __init__(self, dim: int, heads: int, norm_eps: float, normalized: bool) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=norm_eps)
        self.attn = _Attention(dim, heads, normalized)
        self.ls1 = _Scale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=norm_eps)
        self.mlp = Mlp(dim)
        self.ls2 = _Scale(dim)

    def forward(
        self, views: Sequence[Tensor], rotations: Sequence[Rotation] | None = None
    ) -> list[Tensor]:
        """Update views float32 [T, C], whose tokens attend to all tokens of all views.

        All but the attention runs for one view at a time, which bounds memory.
        """
        parts = [
            self.attn.parts(self.norm1(view), None if rotations is None else rotations[n])
            for n, view in enumerate(views)
        ]
        q, k, v = (torch.cat(part, dim=1) for part in zip(*parts, strict=True))
        del parts
        attended = scaled_dot_product_attention(q[None], k[None], v[None])[0].transpose(0, 1)
        del q, k, v
        result = []
        for view, part in zip(views, attended.split([len(view) for view in views]), strict=True):
            x = self.ls1(view, self.attn.proj(part.flatten(1)))
            result.append(self.ls2(x, self.mlp(self.norm2(x))))
        return result


class _Scale(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor, change: Tensor) -> Tensor:
        # Residual sums stay in float32, even if the blocks run in half precision.
        return torch.addcmul(x, self.gamma, change.float())


class _Attention(nn.Module):
    def __init__(self, dim: int, heads: int, normalized: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        self.q_norm, self.k_norm = (
            nn.LayerNorm(dim // heads) if normalized else nn.Identity() for _ in range(2)
        )

    def parts(self, x: Tensor, rotation: Rotation | None) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values [heads, T, head_dim] of tokens [T, C]."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(1, 2, 0, 3)
        q, k = rotated(self.q_norm(q), rotation), rotated(self.k_norm(k), rotation)
        return q.to(v.dtype), k.to(v.dtype), v


@dataclass(frozen=True, eq=False)
class ViewFeatures:
    """Output of the backbone for one view of rows * columns tokens."""

    levels: list[Tensor]  # four of float32 [rows * columns, 2 C], row by row, for the head
    token: Tensor  # float32 [2 C], for the camera decoder
    rows: int
    columns: int


class Transformer(nn.Module):
    """Compute features of all views of a pass."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        dim = config.embed_dim
        self.head_dim = dim // config.heads
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.camera_token = nn.Parameter(torch.zeros(1, 2, dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + POSITIONS**2, dim))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, dim, PATCH, stride=PATCH)})
        self.blocks = nn.ModuleList(
            Block(dim, config.heads, BLOCK_NORM_EPS, normalized=n >= FIRST_GLOBAL)
            for n in range(DEPTH)
        )
        self.norm = nn.LayerNorm(dim)

    def forward(
        self,
        views: Sequence[Tensor],
        reference: int | None = None,
    ) -> list[ViewFeatures]:
        """Compute features per view.

        Args:
            views: float32 [3, H, W] each, normalized; H and W are multiples of 14.
            reference: index of the reference view, whose camera frame the world is close to; by
                default it is chosen.
        """
        grids = [(view.shape[-2] // PATCH, view.shape[-1] // PATCH) for view in views]
        embeddings = {grid: self.positions(*grid) for grid in set(grids)}
        tokens = [
            self.embedded(view, embeddings[grid]) for view, grid in zip(views, grids, strict=True)
        ]
        # The view of each entry of ``tokens``: the reference comes first.
        order = list(range(len(views)))
        for n in range(FIRST_GLOBAL):
            if n == CHOICE_BLOCK and len(views) >= MIN_VIEWS_TO_CHOOSE:
                if reference is None:
                    reference = reference_view(torch.stack([one[0] for one in tokens]))
                order.insert(0, order.pop(reference))
                tokens.insert(0, tokens.pop(reference))
            for at, one in enumerate(tokens):
                tokens[at] = self.blocks[n]([one])[0]
        for at, one in enumerate(tokens):
            token = self.camera_token[0, min(at, 1)]
            tokens[at] = torch.cat([token.to(one.dtype)[None], one[1:]])
        rotations = {grid: self.rotations(*grid) for grid in set(grids)}
        local_turns, global_turns = zip(*(rotations[grids[view]] for view in order), strict=True)
        levels: list[list[Tensor]] = [[] for _ in views]
        last: dict[int, Tensor] = {}
        for n in range(FIRST_GLOBAL, DEPTH, 2):
            for at, one in enumerate(tokens):
                tokens[at] = self.blocks[n]([one], [local_turns[at]])[0]
            local = tokens
            tokens = self.blocks[n + 1](local, global_turns)
            if n + 1 in OUTPUT_BLOCKS:
                for at, view in enumerate(order):
                    levels[view].append(
                        torch.cat([local[at][1:], self.norm(tokens[at][1:])], dim=-1)
                    )
                    last[view] = torch.cat([local[at][0], tokens[at][0]])
        return [
            ViewFeatures(levels[view], last[view], rows, columns)
            for view, (rows, columns) in enumerate(grids)
        ]

    def embedded(self, view: Tensor, positions: Tensor) -> Tensor:
        """Tokens float32 [1 + rows * columns, C] of a view, the class token first."""
        patches = self.patch_embed["proj"](view[None])[0].flatten(1).mT.float()
        return torch.cat([self.cls_token[0], patches]) + positions

    def positions(self, rows: int, columns: int) -> Tensor:
        """The position embedding [1 + rows * columns, C] of a token grid."""
        stored = self.pos_embed.float()
        if rows == columns == POSITIONS:
            return stored[0]
        grid = stored[:, 1:].unflatten(1, (POSITIONS, POSITIONS)).permute(0, 3, 1, 2)
        # torch samples by the factors, which differ from the sizes by the offset.
        factors = [(side + RESAMPLING_OFFSET) / POSITIONS for side in (rows, columns)]
        resampled = interpolate(grid, scale_factor=factors, mode="bicubic")
        return torch.cat([stored[0, :1], resampled[0].flatten(1).mT])

    def rotations(self, rows: int, columns: int) -> tuple[Rotation, Rotation]:
        """Rotations of a token grid, for blocks within a view and for blocks of all views.

        The camera token is at (0, 0). Patches are counted from (1, 1); for blocks of all views
        they are all at (1, 1), so that views are a set.
        """
        device = self.pos_embed.device
        patches = torch.cartesian_prod(
            torch.arange(1, rows + 1, device=device), torch.arange(1, columns + 1, device=device)
        )
        positions = torch.cat([patches.new_zeros(1, 2), patches])
        return (
            rotary_tables(positions, self.head_dim),
            rotary_tables(positions.clamp(max=1), self.head_dim),
        )


def reference_view(tokens: Tensor) -> int:
    """Choose the reference view by the class tokens [S, C] of views, as "saddle_balanced".

    It is closest to the middle of the range of three measures: its mean similarity to other views,
    and the length and the variance of its token.
    """
    tokens = tokens.float()
    lengths = tokens.norm(dim=-1)
    directions = tokens / lengths[:, None]
    similarity = directions @ directions.mT
    similarity.fill_diagonal_(0.0)
    measures = torch.stack(
        [similarity.sum(dim=1) / max(len(tokens) - 1, 1), lengths, directions.var(dim=-1)]
    )
    least = measures.amin(dim=1, keepdim=True)
    ranges = measures.amax(dim=1, keepdim=True) - least
    distance = ((measures - least) / (ranges + 1e-8) - 0.5).abs().sum(dim=0)
    return int(distance.argmin())
