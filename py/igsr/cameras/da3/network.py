"""Depth Anything 3: depths, rays and cameras of all views of a scene (arXiv 2511.10647, section 3).

Module names are as in the checkpoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from igsr.cameras.da3.backbone import Block, NetworkConfig, Transformer
from igsr.cameras.da3.cameras import encode_pose, normalized_viewmats
from igsr.cameras.da3.head import DualHead

#: Numbers of a pose encoding: center, quaternion, two fields of view.
ENCODING = 9
#: Blocks of the camera encoder.
CAMERA_DEPTH = 4


@dataclass(frozen=True, eq=False)
class ViewPrediction:
    """Predictions for one view of H x W pixels (gh = H / 14, gw = W / 14).

    A ray is its direction (with z of 1 in the camera) and origin in the pass's world frame, at the
    pixel centers of a grid of 8 gh x 8 gw. Confidences are not calibrated.
    """

    depth: Tensor  # float32 [H, W], z-depth in an arbitrary unit per pass, positive
    confidence: Tensor  # float32 [H, W], above 1
    rays: Tensor | None  # float32 [8 gh, 8 gw, 6]; None if not computed
    ray_confidence: Tensor | None  # float32 [8 gh, 8 gw], above 1; None if not computed
    pose_encoding: Tensor  # float32 [9], see ``igsr.cameras.da3.cameras``


class CameraDecoder(nn.Module):
    """Decode pose encodings [..., 9] from tokens [..., dim]."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.backbone = nn.Sequential(
            nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim), nn.ReLU()
        )
        self.fc_t, self.fc_qvec = nn.Linear(dim, 3), nn.Linear(dim, 4)
        self.fc_fov = nn.Sequential(nn.Linear(dim, 2), nn.ReLU())

    def forward(self, token: Tensor) -> Tensor:
        x = self.backbone(token.float())
        return torch.cat([self.fc_t(x), self.fc_qvec(x), self.fc_fov(x)], dim=-1)


class CameraEncoder(nn.Module):
    """Encode the pose encodings [S, 9] of all views of a pass to tokens float32 [S, dim]."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.pose_branch = nn.ModuleDict(
            {"fc1": nn.Linear(ENCODING, dim // 2), "fc2": nn.Linear(dim // 2, dim)}
        )
        self.token_norm = nn.LayerNorm(dim)
        # Unlike the backbone's, these blocks' norms have torch's default epsilon.
        self.trunk = nn.ModuleList(
            Block(dim, heads, norm_eps=1e-5, normalized=False) for _ in range(CAMERA_DEPTH)
        )
        self.trunk_norm = nn.LayerNorm(dim)

    def forward(self, encodings: Tensor) -> Tensor:
        hidden = nn.functional.gelu(self.pose_branch["fc1"](encodings))
        tokens = self.token_norm(self.pose_branch["fc2"](hidden).float())
        for block in self.trunk:
            (tokens,) = block([tokens])
        return self.trunk_norm(tokens)


class Da3Network(nn.Module):
    """The network for any number of views."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = nn.ModuleDict({"pretrained": Transformer(config)})
        self.head = DualHead(config)
        self.cam_dec = CameraDecoder(2 * config.embed_dim)
        self.cam_enc = CameraEncoder(config.embed_dim, config.camera_heads)

    def predict(
        self,
        views: Sequence[Tensor],
        viewmats: Tensor | None = None,
        intrinsics: Tensor | None = None,
        *,
        rays: bool = True,
        reference: int | None = None,
    ) -> list[ViewPrediction]:
        """Predict depths, rays and cameras of views that may differ in size.

        Time grows with the square of the number of views, memory linearly.

        Args:
            views: float32 [3, H, W] each, H and W multiples of 14.
            viewmats: float [S, 4, 4], world to camera, in any world and unit, if known.
            intrinsics: float [S, 3, 3], pixels of the views; needed with ``viewmats``.
            rays: whether to predict rays, which takes about as long as depth.
            reference: index of the view whose camera frame the world is close to; by default it is
                chosen. Of one or two views, and with known cameras, it is always the first.

        Returns:
            Predictions per view.
        """
        tokens, device = None, views[0].device
        if viewmats is not None and intrinsics is not None:
            sizes = [(view.shape[-2], view.shape[-1]) for view in views]
            encoding = encode_pose(normalized_viewmats(viewmats), intrinsics, sizes)
            with torch.autocast(device.type, enabled=False):
                tokens = self.cam_enc(encoding.to(device, torch.float32))
        features = self.backbone["pretrained"](views, reference, tokens)
        predictions = []
        # Depths span orders of magnitude, which half precision and TF32 would round visibly.
        with (
            torch.autocast(device.type, enabled=False),
            torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False),
        ):
            while features:
                view = features.pop(0)
                depth, confidence, ray, ray_confidence = self.head(view, rays)
                encoding = self.cam_dec(view.token)
                predictions.append(ViewPrediction(depth, confidence, ray, ray_confidence, encoding))
        return predictions
