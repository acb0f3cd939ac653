"""What the transformers of pose networks share: the perceptron, and rotary position embeddings.

The embeddings are those of rows and columns (Su et al. 2021, in two dimensions as in CroCo v2,
Weinzaepfel et al., ICCV 2023).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

#: Hidden channels of a block's perceptron per channel of the block.
MLP_RATIO = 4
#: Base of the rotary embedding's frequencies.
ROTARY_BASE = 100.0

Rotation = tuple[Tensor, Tensor]


class Mlp(nn.Module):
    """The perceptron of a block; its names are those of the checkpoints' keys."""

    def __init__(self, dim: int) -> None:
        """For tokens of ``dim`` channels."""
        super().__init__()
        self.fc1 = nn.Linear(dim, MLP_RATIO * dim)
        self.act = nn.GELU()
        self.fc2 = nn.Linear(MLP_RATIO * dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """Tokens [..., T, dim] to the same."""
        return self.fc2(self.act(self.fc1(x)))


def rotary_tables(places: Tensor, head_dim: int) -> Rotation:
    """Cosines and sines float32 [T, 2, head_dim / 4] of the turns of tokens.

    The first half of a head's channels is turned by the token's row, the second by its column;
    within a half of 2q channels, those i and i + q are turned together by row * 100^(-i / q).

    Args:
        places: [T, 2], row and column.
        head_dim: channels of a head, a multiple of four.
    """
    quarter = head_dim // 4
    turn = ROTARY_BASE ** (-torch.arange(quarter, device=places.device) / quarter)
    angles = places.float()[..., None] * turn
    return angles.cos(), angles.sin()


def rotated(x: Tensor, rotation: Rotation | None) -> Tensor:
    """Queries or keys [..., T, head_dim] turned by their tokens' places; None turns nothing."""
    if rotation is None:
        return x
    cosine, sine = rotation
    # In float32 whatever x is in: half precision cannot tell the angles of distant tokens apart.
    u, v = x.float().unflatten(-1, (2, 2, -1)).unbind(-2)
    turned = torch.stack([u * cosine - v * sine, v * cosine + u * sine], dim=-2)
    return turned.flatten(-3).to(x.dtype)
