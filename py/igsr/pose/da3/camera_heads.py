"""Cameras as tokens of Depth Anything 3: the decoder that reads them, the encoder that writes them.

arXiv 2511.10647, section 3. Module names are those of the checkpoints' keys. What the nine numbers
of a camera are is told in ``igsr.pose.da3.cameras``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from igsr.pose.da3.blocks import Block
from igsr.pose.da3.config import CAMERA_DEPTH

#: Numbers of a camera: centre, quaternion, two fields of view.
CAMERA = 9


class CameraDecoder(nn.Module):
    """The nine numbers of a view's camera from its token.

    Args:
        dim: channels of the token.
    """

    def __init__(self, dim: int) -> None:
        """Make the layers."""
        super().__init__()
        self.backbone = nn.Sequential(
            nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim), nn.ReLU()
        )
        self.fc_t, self.fc_qvec = nn.Linear(dim, 3), nn.Linear(dim, 4)
        self.fc_fov = nn.Sequential(nn.Linear(dim, 2), nn.ReLU())

    def forward(self, token: Tensor) -> Tensor:
        """Numbers [..., 9] of tokens [..., dim]."""
        x = self.backbone(token.float())
        return torch.cat([self.fc_t(x), self.fc_qvec(x), self.fc_fov(x)], dim=-1)


class CameraEncoder(nn.Module):
    """A token per view from the nine numbers of its camera.

    Args:
        dim: channels of the tokens.
        heads: of the attention between views.
    """

    def __init__(self, dim: int, heads: int) -> None:
        """Make the layers."""
        super().__init__()
        self.pose_branch = nn.ModuleDict(
            {"fc1": nn.Linear(CAMERA, dim // 2), "fc2": nn.Linear(dim // 2, dim)}
        )
        self.token_norm = nn.LayerNorm(dim)
        # Unlike the backbone's, these blocks' norms have torch's default epsilon.
        self.trunk = nn.ModuleList(
            Block(dim, heads, norm_eps=1e-5, normalised=False) for _ in range(CAMERA_DEPTH)
        )
        self.trunk_norm = nn.LayerNorm(dim)

    def forward(self, encodings: Tensor) -> Tensor:
        """Tokens float32 [S, dim] of the cameras [S, 9] of all views of a pass."""
        hidden = nn.functional.gelu(self.pose_branch["fc1"](encodings))
        tokens = self.token_norm(self.pose_branch["fc2"](hidden).float())
        for block in self.trunk:
            (tokens,) = block([tokens])
        return self.trunk_norm(tokens)
