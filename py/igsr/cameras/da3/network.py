"""Depth Anything 3: depths and cameras of all views of a scene (arXiv 2511.10647, section 3).

Module names are as in the checkpoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from igsr.cameras.da3.backbone import NetworkConfig, Transformer
from igsr.cameras.da3.head import DepthHead


@dataclass(frozen=True, eq=False)
class ViewPrediction:
    """Predictions for one view of H x W pixels. Confidences are not calibrated."""

    depth: Tensor  # float32 [H, W], z-depth in an arbitrary unit per pass, positive
    confidence: Tensor  # float32 [H, W], above 1
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


class Da3Network(nn.Module):
    """The network for any number of views."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = nn.ModuleDict({"pretrained": Transformer(config)})
        self.head = DepthHead(config)
        self.cam_dec = CameraDecoder(2 * config.embed_dim)

    def predict(
        self,
        views: Sequence[Tensor],
        reference: int | None = None,
    ) -> list[ViewPrediction]:
        """Predict depths and cameras of views that may differ in size.

        Time grows with the square of the number of views, memory linearly.

        Args:
            views: float32 [3, H, W] each, H and W multiples of 14.
            reference: index of the view whose camera frame the world is close to; by default it is
                chosen. Of one or two views it is always the first.

        Returns:
            Predictions per view.
        """
        features = self.backbone["pretrained"](views, reference)
        predictions = []
        # Depths span orders of magnitude, which half precision and TF32 would round visibly.
        with (
            torch.autocast(views[0].device.type, enabled=False),
            torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False),
        ):
            while features:
                view = features.pop(0)
                depth, confidence = self.head(view)
                predictions.append(ViewPrediction(depth, confidence, self.cam_dec(view.token)))
        return predictions
