"""The backbone of Depth Anything 3: a DINOv2 transformer some of whose blocks attend to all views.

Depth Anything 3 (arXiv 2511.10647), section 3; DINOv2 (Oquab et al. 2023). Module names are those
of the checkpoints' keys.

Views are a list of token arrays, so that views of several sizes can go through one pass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from igsr.pose.da3.blocks import Block
from igsr.pose.da3.config import ALTERNATES, DEPTH, PATCH, POSITIONS, TAKEN, NetworkConfig
from igsr.pose.transformer_layers import Rotation, rotary_tables

#: Of the norms before attention and perceptron; all others have torch's default of 1e-5.
BLOCK_NORM_EPS = 1e-6
#: Added to a photo's rows and columns of tokens where the position embedding is resampled, as in
#: DINOv2: it moves the places that are sampled.
OFFSET = 0.1
#: The block before which the reference view is chosen, and the fewest views of which one is.
CHOICE, FEWEST_TO_CHOOSE = ALTERNATES - 1, 3


@dataclass(frozen=True, eq=False)
class ViewFeatures:
    """What the backbone gives of one view.

    Attributes:
        levels: four arrays float32 [gh * gw, 2 C], row by row, for the head.
        token: float32 [2 C], for the camera decoder.
        rows, columns: gh and gw, of the grid of tokens, ``PATCH`` pixels each.
    """

    levels: list[Tensor]
    token: Tensor
    rows: int
    columns: int


class Backbone(nn.Module):
    """Features of all views of a pass.

    Args:
        config: the sizes.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """Make the layers, which the checkpoints nest under the name ``pretrained``."""
        super().__init__()
        self.pretrained = _Transformer(config)

    def forward(
        self,
        views: Sequence[Tensor],
        choose: Callable[[Tensor], int],
        camera_tokens: Tensor | None = None,
    ) -> list[ViewFeatures]:
        """Features per view, in the order given.

        Args:
            views: float32 [3, H, W] each, normalised; sides are multiples of 14.
            choose: takes class tokens [S, C] of three views or more and gives the index of the
                reference view. Of two views it is the first.
            camera_tokens: [S, C] where cameras are given; nothing is chosen then.
        """
        return self.pretrained(views, choose, camera_tokens)


class _Transformer(nn.Module):
    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        dim = config.embed_dim
        self.head_dim = dim // config.heads
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.camera_token = nn.Parameter(torch.zeros(1, 2, dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + POSITIONS**2, dim))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, dim, PATCH, stride=PATCH)})
        self.blocks = nn.ModuleList(
            Block(dim, config.heads, BLOCK_NORM_EPS, normalised=n >= ALTERNATES)
            for n in range(DEPTH)
        )
        self.norm = nn.LayerNorm(dim)

    def forward(
        self,
        views: Sequence[Tensor],
        choose: Callable[[Tensor], int],
        camera_tokens: Tensor | None,
    ) -> list[ViewFeatures]:
        grids = [(view.shape[-2] // PATCH, view.shape[-1] // PATCH) for view in views]
        embeddings = {grid: self.positions(*grid) for grid in set(grids)}
        tokens = [
            self.embedded(view, embeddings[grid]) for view, grid in zip(views, grids, strict=True)
        ]
        # Which view each entry of ``tokens`` is of: the reference goes first.
        order = list(range(len(views)))
        for n in range(ALTERNATES):
            if n == CHOICE and camera_tokens is None and len(views) >= FEWEST_TO_CHOOSE:
                reference = choose(torch.stack([one[0] for one in tokens]))
                order.insert(0, order.pop(reference))
                tokens.insert(0, tokens.pop(reference))
            for at, one in enumerate(tokens):
                tokens[at] = self.blocks[n]([one])[0]
        for at, one in enumerate(tokens):
            token = self.camera_token[0, min(at, 1)] if camera_tokens is None else camera_tokens[at]
            tokens[at] = torch.cat([token.to(one.dtype)[None], one[1:]])
        grids_in_order = [grids[view] for view in order]
        apart, together = ([turns[grid] for grid in grids_in_order] for turns in self.turns(grids))
        levels: list[list[Tensor]] = [[] for _ in views]
        last: dict[int, Tensor] = {}
        for n in range(ALTERNATES, DEPTH, 2):
            for at, one in enumerate(tokens):
                tokens[at] = self.blocks[n]([one], [apart[at]])[0]
            local = tokens
            tokens = self.blocks[n + 1](local, together)
            if n + 1 in TAKEN:
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
        """Tokens float32 [1 + gh * gw, C] of a view, the class token first."""
        patches = self.patch_embed["proj"](view[None])[0].flatten(1).mT.float()
        return torch.cat([self.cls_token[0], patches]) + positions

    def positions(self, rows: int, columns: int) -> Tensor:
        """The position embedding [1 + rows * columns, C] of a grid of tokens."""
        stored = self.pos_embed.float()
        if rows == columns == POSITIONS:
            return stored[0]
        grid = stored[:, 1:].unflatten(1, (POSITIONS, POSITIONS)).permute(0, 3, 1, 2)
        # The factors, not the sizes, say where is sampled.
        factors = [(side + OFFSET) / POSITIONS for side in (rows, columns)]
        resampled = interpolate(grid, scale_factor=factors, mode="bicubic")
        return torch.cat([stored[0, :1], resampled[0].flatten(1).mT])

    def turns(
        self, grids: Sequence[tuple[int, int]]
    ) -> tuple[dict[tuple[int, int], Rotation], dict[tuple[int, int], Rotation]]:
        """Rotations per grid of tokens, where views are apart and where they are together.

        The camera token is at (0, 0). Patches are counted from (1, 1) where a view is apart; where
        all views are together all patches are at (1, 1), which makes views a set.
        """
        apart, together = {}, {}
        for rows, columns in set(grids):
            device = self.pos_embed.device
            patches = torch.cartesian_prod(
                torch.arange(1, rows + 1, device=device),
                torch.arange(1, columns + 1, device=device),
            )
            places = torch.cat([patches.new_zeros(1, 2), patches])
            apart[rows, columns] = rotary_tables(places, self.head_dim)
            together[rows, columns] = rotary_tables(places.clamp(max=1), self.head_dim)
        return apart, together
