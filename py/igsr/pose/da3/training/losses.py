"""What makes a prediction wrong.

The sum of Depth Anything 3 (arXiv 2511.10647, section 3): absolute errors of depth, of rays, of the
points that both give, of the nine numbers of the camera, and of the slopes of the depth. Depth
and rays weigh each error by the confidence that is predicted with it, less a share of its
logarithm, as DUSt3R does (Wang et al., CVPR 2024, equation 4): to be sure pays where one is right.
All of it is in the unit of ``TruePass``.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from igsr.pose.da3.cameras import encode_pose
from igsr.pose.da3.network import Prediction
from igsr.pose.da3.training.true_pass import TruePass

#: What a unit of the logarithm of the confidence is worth (alpha in DUSt3R).
SURE = 0.2


def losses(predicted: Prediction, true: TruePass) -> dict[str, Tensor]:
    """The parts of the loss, each a mean; their sum is what is made small.

    Args:
        predicted: of the photos of the pass, with the first as the reference.
        true: on the same device.

    Returns:
        "depth", "rays", "points", "camera" and "slopes", scalars with gradients.
    """
    known = true.depth > 0.0
    height, width = true.depth.shape[1:]
    rays = true_rays(true, *predicted.rays.shape[1:3])
    # Rays come on a grid of their own: those of the pixels lie between.
    directions, origins = (
        interpolate(half.movedim(-1, 1), size=(height, width), mode="bilinear").movedim(1, -1)
        for half in predicted.rays.split(3, dim=-1)
    )
    points = predicted.depth[..., None] * directions + origins
    true_directions, true_origins = true_rays(true, height, width).split(3, dim=-1)
    true_points = true.depth[..., None] * true_directions + true_origins
    return {
        "depth": _sure((predicted.depth - true.depth).abs()[known], predicted.confidence[known]),
        "rays": _sure((predicted.rays - rays).abs().mean(dim=-1), predicted.ray_confidence),
        "points": _mean((points - true_points).abs().mean(dim=-1)[known]),
        "camera": _camera(predicted.pose_encoding, true),
        "slopes": _slopes(predicted.depth, true.depth, known),
    }


def true_rays(true: TruePass, height: int, width: int) -> Tensor:
    """Rays [S, height, width, 6] (direction, origin) at the pixel centres of a grid of a size."""
    device = true.depth.device
    rows, columns = true.depth.shape[1:]
    x, y = torch.meshgrid(
        (torch.arange(width, device=device) + 0.5) * (columns / width),
        (torch.arange(height, device=device) + 0.5) * (rows / height),
        indexing="xy",
    )
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    rotation = true.viewmats[:, :3, :3].mT  # camera to world
    to_world = rotation @ torch.linalg.inv(true.intrinsics)
    directions = torch.einsum("sij,hwj->shwi", to_world, pixels)
    centres = -(rotation @ true.viewmats[:, :3, 3:])[..., 0]
    return torch.cat([directions, centres[:, None, None].expand_as(directions)], dim=-1)


def _camera(encoding: Tensor, true: TruePass) -> Tensor:
    height, width = true.depth.shape[1:]
    sizes = [(height, width)] * len(encoding)
    wanted = encode_pose(true.viewmats.cpu(), true.intrinsics.cpu(), sizes).to(encoding)
    # A quaternion and its opposite are one rotation.
    turn = [(encoding[:, 3:7] - sign * wanted[:, 3:7]).abs().sum(dim=1) for sign in (1.0, -1.0)]
    rest = torch.cat([encoding[:, :3] - wanted[:, :3], encoding[:, 7:] - wanted[:, 7:]], dim=1)
    return ((rest.abs().sum(dim=1) + torch.minimum(*turn)) / encoding.shape[1]).mean()


def _slopes(depth: Tensor, wanted: Tensor, known: Tensor) -> Tensor:
    """Mean error of the differences between neighbours that are both known."""
    error = depth - wanted
    across = (error[:, :, 1:] - error[:, :, :-1]).abs()[known[:, :, 1:] & known[:, :, :-1]]
    down = (error[:, 1:] - error[:, :-1]).abs()[known[:, 1:] & known[:, :-1]]
    return _mean(across) + _mean(down)


def _sure(error: Tensor, confidence: Tensor) -> Tensor:
    return _mean(confidence * error - SURE * confidence.log())


def _mean(values: Tensor) -> Tensor:
    """The mean; 0, with gradients of 0, of no values."""
    return values.sum() / max(1, values.numel())
