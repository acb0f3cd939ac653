"""Transformer blocks of Depth Anything 3, for views of any sizes.

The blocks are those of DINOv2 (Oquab et al. 2023); later ones have normalised queries and keys, and
rotary positions of rows and columns (Su et al. 2021). Module names are those of the checkpoints'
keys.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from igsr.pose.transformer_layers import Mlp, Rotation, rotated


class Block(nn.Module):
    """Attention, then a perceptron, each added to its input with a factor per channel.

    Args:
        dim: channels.
        heads: of the attention.
        norm_eps: of the norms before attention and perceptron.
        normalised: whether queries and keys are normalised.
    """

    def __init__(self, dim: int, heads: int, norm_eps: float, normalised: bool) -> None:
        """Make the layers."""
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=norm_eps)
        self.attn = _Attention(dim, heads, normalised)
        self.ls1 = _Scale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=norm_eps)
        self.mlp = Mlp(dim)
        self.ls2 = _Scale(dim)

    def forward(
        self, views: Sequence[Tensor], rotations: Sequence[Rotation] | None = None
    ) -> list[Tensor]:
        """The views after a block whose tokens attend to all tokens of all views.

        Everything but the attention is done for one view at a time, which bounds memory.

        Args:
            views: float32 [T, C] each; T may differ.
            rotations: of each view's queries and keys, or None for none.

        Returns:
            As ``views``.
        """
        parts = [
            self.attn.parts(self.norm1(view), None if rotations is None else rotations[n])
            for n, view in enumerate(views)
        ]
        q, k, v = (torch.cat(part, dim=1) for part in zip(*parts, strict=True))
        del parts
        gathered = scaled_dot_product_attention(q[None], k[None], v[None])[0].transpose(0, 1)
        del q, k, v
        split = gathered.split([len(view) for view in views])
        result = []
        for view, part in zip(views, split, strict=True):
            x = self.ls1(view, self.attn.proj(part.flatten(1)))
            result.append(self.ls2(x, self.mlp(self.norm2(x))))
        return result


class _Scale(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor, change: Tensor) -> Tensor:
        # The sums that the blocks add to stay in float32, whatever the blocks compute in.
        return torch.addcmul(x, self.gamma, change.float())


class _Attention(nn.Module):
    def __init__(self, dim: int, heads: int, normalised: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        self.q_norm, self.k_norm = (
            nn.LayerNorm(dim // heads) if normalised else nn.Identity() for _ in range(2)
        )

    def parts(self, x: Tensor, rotation: Rotation | None) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values [heads, T, head_dim] of tokens [T, C]."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(1, 2, 0, 3)
        q, k = rotated(self.q_norm(q), rotation), rotated(self.k_norm(k), rotation)
        return q.to(v.dtype), k.to(v.dtype), v
