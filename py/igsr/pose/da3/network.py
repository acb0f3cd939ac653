"""Depth Anything 3: depths, rays and cameras of all views of a scene from their pixels.

arXiv 2511.10647. Module names are those of the checkpoints' keys.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from igsr.errors import IgsrError
from igsr.pose.da3.backbone import Backbone
from igsr.pose.da3.camera_heads import CameraDecoder, CameraEncoder
from igsr.pose.da3.cameras import encode_pose, normalized_viewmats
from igsr.pose.da3.config import PATCH, NetworkConfig
from igsr.pose.da3.head import DualHead, ViewMaps
from igsr.pose.da3.reference_view import REFERENCES, USUAL, reference_view

__all__ = ["Da3Network", "NetworkConfig", "Prediction", "ViewPrediction"]


@dataclass(frozen=True, eq=False)
class ViewPrediction:
    """What the network says of one view of H x W pixels (gh = H / 14, gw = W / 14).

    Attributes:
        depth: float32 [H, W], z-depth in the pass's own unit, positive.
        confidence: float32 [H, W], above 1, not calibrated.
        rays: float32 [8 gh, 8 gw, 6], direction (its z in the camera is 1) and origin in the
            pass's world frame; None if not asked for.
        ray_confidence: float32 [8 gh, 8 gw], above 1; None if not asked for.
        pose_encoding: float32 [9], see ``igsr.pose.da3.cameras.decode_pose``.
    """

    depth: Tensor
    confidence: Tensor
    rays: Tensor | None
    ray_confidence: Tensor | None
    pose_encoding: Tensor


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the network says of S views of one size; fields as ``ViewPrediction``'s, stacked.

    Attributes:
        depth: float32 [S, H, W].
        confidence: float32 [S, H, W].
        rays: float32 [S, 8 gh, 8 gw, 6].
        ray_confidence: float32 [S, 8 gh, 8 gw].
        pose_encoding: float32 [S, 9].
    """

    depth: Tensor
    confidence: Tensor
    rays: Tensor
    ray_confidence: Tensor
    pose_encoding: Tensor


class Da3Network(nn.Module):
    """The any-view network.

    Args:
        config: the sizes.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """Make the layers."""
        super().__init__()
        self.config = config
        self.backbone = Backbone(config)
        self.head = DualHead(config)
        self.cam_dec = CameraDecoder(2 * config.embed_dim)
        self.cam_enc = CameraEncoder(config.embed_dim, config.camera_heads)

    def forward(
        self,
        pixels: Tensor,
        reference: str = USUAL,
        viewmats: Tensor | None = None,
        intrinsics: Tensor | None = None,
    ) -> Prediction:
        """Depths, rays and cameras of views of one size.

        Args:
            pixels: float32 [S, 3, H, W], as ``igsr.pose.da3.preprocessing`` makes them.
            reference, viewmats, intrinsics: as ``predict``.

        Raises:
            IgsrError: as ``predict``.
        """
        views = self.predict(list(pixels), reference, viewmats, intrinsics)
        stacked = {
            name: torch.stack([getattr(view, name) for view in views])
            for name in ("depth", "confidence", "rays", "ray_confidence", "pose_encoding")
        }
        return Prediction(**stacked)

    def predict(
        self,
        views: Sequence[Tensor],
        reference: str = USUAL,
        viewmats: Tensor | None = None,
        intrinsics: Tensor | None = None,
        *,
        rays: bool = True,
    ) -> list[ViewPrediction]:
        """Depths, rays and cameras of views that may differ in size.

        Time grows with the square of the number of views, memory with the number.

        Args:
            views: float32 [3, H, W] each, H and W multiples of 14.
            reference: how the view is chosen whose camera frame the world is close to; one of
                ``igsr.pose.da3.reference_view.REFERENCES``.
            viewmats: float [S, 4, 4], world to camera, any world and unit, if cameras are known.
            intrinsics: float [S, 3, 3], pixels of the views; given if ``viewmats`` are.
            rays: whether rays are wanted; they take about as long as depth.

        Returns:
            What is said of each view, in the order given.

        Raises:
            IgsrError: there is no view, a view has another shape, ``reference`` is unknown, or only
                one of ``viewmats`` and ``intrinsics`` is given or it is not of all views.
        """
        _check(views, reference, viewmats, intrinsics)
        tokens = None
        if viewmats is not None and intrinsics is not None:
            sizes = [(view.shape[-2], view.shape[-1]) for view in views]
            encoding = encode_pose(normalized_viewmats(viewmats), intrinsics, sizes)
            device = views[0].device
            with torch.autocast(device.type, enabled=False):
                tokens = self.cam_enc(encoding.to(device, torch.float32))
        features = self.backbone(
            views, lambda all_tokens: reference_view(all_tokens, reference), tokens
        )
        result = []
        device = views[0].device
        # Depths span orders of magnitude, which half precision and TF32 would round visibly.
        with (
            torch.autocast(device.type, enabled=False),
            torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False),
        ):
            while features:
                view = features.pop(0)
                maps: ViewMaps = self.head(view, rays)
                result.append(ViewPrediction(**vars(maps), pose_encoding=self.cam_dec(view.token)))
        return result


def _check(
    views: Sequence[Tensor], reference: str, viewmats: Tensor | None, intrinsics: Tensor | None
) -> None:
    if not views:
        raise IgsrError("views is empty; give at least one")
    for n, view in enumerate(views):
        shape = list(view.shape)
        if len(shape) != 3 or shape[0] != 3 or any(n < 1 or n % PATCH for n in shape[1:]):
            raise IgsrError(
                f"view {n} has shape {shape}; give [3, H, W] with H and W multiples of {PATCH}"
            )
    if reference not in REFERENCES:
        raise IgsrError(f"reference is {reference!r}; give one of {', '.join(REFERENCES)}")
    if (viewmats is None) != (intrinsics is None):
        raise IgsrError("viewmats and intrinsics belong together; give both or neither")
    for name, value, side in (("viewmats", viewmats, 4), ("intrinsics", intrinsics, 3)):
        if value is not None and list(value.shape) != [len(views), side, side]:
            raise IgsrError(
                f"{name} has shape {list(value.shape)}; give {[len(views), side, side]}, one for "
                "every view: the network knows no views without cameras among those that have them"
            )
