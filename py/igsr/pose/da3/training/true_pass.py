"""Photos of one capture as the network sees them, with the truth about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr.capture import Camera, View
from igsr.pose.da3.preprocessing import network_input, resampling_of
from igsr.pose.grid import Grid
from igsr.pose.photo_samples import over_white

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TruePass:
    """S photos of one size, H x W pixels, and what a network should say of them.

    The world is the frame of the first photo's camera. Its unit is the mean distance of the known
    points from that camera, as in DUSt3R (Wang et al., CVPR 2024), VGGT (Wang et al., CVPR 2025)
    and Depth Anything 3: no photo tells how large things are.

    Attributes:
        pixels: float32 [S, 3, H, W], normalised.
        viewmats: float32 [S, 4, 4], world to camera; the first is the identity.
        intrinsics: float32 [S, 3, 3], pixels.
        depth: float32 [S, H, W], z-depth, 0 where nothing is hit.
    """

    pixels: Tensor
    viewmats: Tensor
    intrinsics: Tensor
    depth: Tensor

    def to(self, device: torch.device) -> TruePass:
        """The same on a device."""
        return TruePass(**{name: value.to(device) for name, value in vars(self).items()})

    def cameras(self) -> list[Camera]:
        """The true cameras."""
        height, width = self.depth.shape[1:]
        pairs = zip(self.viewmats.double().numpy(), self.intrinsics.double().numpy(), strict=True)
        return [Camera(viewmat, K, width, height) for viewmat, K in pairs]


def true_pass(views: Sequence[View], resolution: int) -> TruePass:
    """A pass of photos.

    Args:
        views: with depth, of one size and one capture; the first is the reference.
        resolution: pixels of the longer side.

    Raises:
        IgsrError: they are too narrow.
    """
    height, width = views[0].image.shape[:2]
    resampling = resampling_of(width, height, resolution)
    pixels = np.stack([network_input(over_white(view.image), resampling) for view in views])
    grid = resampling.grid()
    depth = np.stack([_on_grid(view.depth, grid) for view in views])
    intrinsics = np.stack([resampling.intrinsics(view.camera.K) for view in views])
    into_first = np.linalg.inv(views[0].camera.viewmat)
    viewmats = np.stack([view.camera.viewmat @ into_first for view in views])
    unit = _unit(depth, viewmats, intrinsics)
    viewmats[:, :3, 3] /= unit
    return TruePass(
        torch.from_numpy(pixels),
        torch.from_numpy(viewmats.astype(np.float32)),
        torch.from_numpy(intrinsics.astype(np.float32)),
        torch.from_numpy((depth / unit).astype(np.float32)),
    )


def _on_grid(depth: npt.NDArray[np.float32] | None, grid: Grid) -> Float64:
    """The depth of the photo's pixel that the middle of each of the grid's lies in."""
    if depth is None:  # no ray of the photo hits anything
        return np.zeros((grid.height, grid.width))
    rows, columns = (
        np.floor((np.arange(count) + 0.5) * scale).astype(np.int64).clip(0, size - 1)
        for count, scale, size in (
            (grid.height, grid.scale_y, depth.shape[0]),
            (grid.width, grid.scale_x, depth.shape[1]),
        )
    )
    return depth[np.ix_(rows, columns)].astype(np.float64)


def _unit(depth: Float64, viewmats: Float64, intrinsics: Float64) -> float:
    """The mean distance of the points from the first camera; 1 where there is none."""
    height, width = depth.shape[1:]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    distances = []
    for plane, viewmat, K in zip(depth, viewmats, intrinsics, strict=True):
        known = plane > 0.0
        points = (pixels[known] * plane[known][:, None]) @ np.linalg.inv(K).T
        distances.append(np.linalg.norm((points - viewmat[:3, 3]) @ viewmat[:3, :3], axis=1))
    joined = np.concatenate(distances)
    return float(joined.mean()) if len(joined) else 1.0
