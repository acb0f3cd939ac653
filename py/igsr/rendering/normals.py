"""Normals of splats: the shortest axis of each, turned to face the camera."""

from __future__ import annotations

import torch
from torch import Tensor


def facing_normals(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, drawn: Tensor
) -> Tensor:
    """Compute unit normals [N, 3], world frame, with gradients of ``quats``.

    Args:
        means: [N, 3] centers, world frame.
        quats: [N, 4] rotations w x y z of any length.
        scales: [N, 3] standard deviations along the splat's axes.
        viewmat: [4, 4] world-to-camera.
        drawn: bool [N]; other splats may have any values, even NaN, and get zero normals.
    """
    # First, since 0 x NaN in a backward pass would be NaN.
    upright = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    quats = torch.where(drawn[:, None], quats, upright)
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(dim=-1)
    # The columns of the rotation matrix, as rows.
    axes = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        dim=1,
    )
    shortest = scales.detach().argmin(dim=-1)
    normals = axes.gather(1, shortest[:, None, None].expand(-1, 1, 3)).squeeze(1)
    with torch.no_grad():
        viewmat = viewmat.to(means)
        rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
        directions = (means @ rotation.T + translation) @ rotation  # camera to center, world frame
        away = (normals * directions).sum(dim=-1) > 0
        signs = torch.where(away, -1.0, 1.0).to(normals) * drawn
    return normals * signs[:, None]
