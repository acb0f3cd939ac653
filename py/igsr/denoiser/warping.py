"""What the photos show at the surface that a render shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from ..capture import Camera, View
from ..evaluation import over_background
from ..rendering import render
from ..splats import Splats

Float32 = npt.NDArray[np.float32]

#: A photo sees a point if the depth rendered from the photo differs from the point's by no more
#: than this part of it.
SAME_DEPTH = 0.03
#: Below this alpha a render has no surface to look up.
SURFACE_ALPHA = 0.5


@dataclass(frozen=True, eq=False)
class Source:
    """A photo to look colours up in.

    Attributes:
        camera: the photo's, OpenCV axes, world frame.
        color: float32 [H, W, 3] in [0, 1], over the background.
        usable: bool [H, W], False where the photo's mask hides it.
        depth: float32 [H, W], rendered from the photo's camera, world units; 0 where nothing is.
    """

    camera: Camera
    color: Float32
    usable: npt.NDArray[np.bool_]
    depth: Float32


@dataclass(frozen=True, eq=False)
class Warped:
    """Colours of the photos at a render's pixels, the photo with the nearest direction first.

    Attributes:
        color: float32 [K, H, W, 3] in [0, 1], zero where not valid.
        valid: bool [K, H, W], whether so many photos see the pixel's surface.
        angle: float32 [K, H, W], between the directions to the surface, radians, or pi.
    """

    color: Float32
    valid: npt.NDArray[np.bool_]
    angle: Float32


def photo_sources(
    splats: Splats, views: Sequence[View], background: Sequence[float], backend: str = "auto"
) -> list[Source]:
    """The photos of ``views``, with the depth that ``splats`` have in them.

    Args:
        splats: the scene fitted to the photos.
        views: the photos.
        background: RGB in [0, 1] behind photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".
    """
    sources = []
    for view in views:
        drawn = render(splats, view.camera, background, backend)
        depth = np.where(drawn.alpha > SURFACE_ALPHA, drawn.expected_depth, np.float32(0.0))
        color = over_background(view.image, background).astype(np.float32) / 255.0
        usable = np.ones(depth.shape, np.bool_) if view.mask is None else view.mask
        sources.append(Source(view.camera, color, usable, depth))
    return sources


def warp_photos(
    camera: Camera, depth: Float32, alpha: Float32, sources: Sequence[Source], keep: int
) -> Warped:
    """Look up each pixel's surface in the photos; keep the ones that look from nearest.

    Args:
        camera: of the render.
        depth: [H, W], mean z along its axis, world units.
        alpha: [H, W]; pixels below ``SURFACE_ALPHA`` show no surface.
        sources: the photos; their order does not matter but among equal angles.
        keep: photos kept per pixel, K; where fewer see it, the rest is not valid.
    """
    height, width = depth.shape
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    K = camera.K
    rays = np.stack(
        [(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], axis=-1
    )
    to_world = np.linalg.inv(camera.viewmat)
    points = (rays * depth[..., None].astype(np.float64)) @ to_world[:3, :3].T + to_world[:3, 3]
    surface = alpha > SURFACE_ALPHA
    here = _directions(points, camera.centre)
    found = [_looked_up(source, points, surface, here) for source in sources]
    angles = np.stack([angle for _, angle in found] or [np.full(depth.shape, np.pi, np.float32)])
    colors = np.stack([color for color, _ in found] or [np.zeros((height, width, 3), np.float32)])
    order = np.argsort(angles, axis=0, kind="stable")[:keep]
    angle = np.take_along_axis(angles, order, axis=0)
    color = np.take_along_axis(colors, order[..., None], axis=0)
    missing = keep - len(angle)
    if missing > 0:
        angle = np.pad(angle, ((0, missing), (0, 0), (0, 0)), constant_values=np.float32(np.pi))
        color = np.pad(color, ((0, missing), (0, 0), (0, 0), (0, 0)))
    return Warped(color, angle < np.float32(np.pi), angle)


def _directions(
    points: npt.NDArray[np.float64], centre: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    directions = points - centre
    unit: npt.NDArray[np.float64] = directions / np.maximum(
        np.linalg.norm(directions, axis=-1, keepdims=True), 1e-12
    )
    return unit


def _looked_up(
    source: Source,
    points: npt.NDArray[np.float64],
    surface: npt.NDArray[np.bool_],
    here: npt.NDArray[np.float64],
) -> tuple[Float32, Float32]:
    """Colour [H, W, 3] and angle [H, W] of one photo; black and pi where it sees no point."""
    camera = source.camera
    inside = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = inside[..., 2]
    front = surface & (z > 1e-6)
    divisor = np.where(front, z, 1.0)
    x = camera.K[0, 0] * inside[..., 0] / divisor + camera.K[0, 2]
    y = camera.K[1, 1] * inside[..., 1] / divisor + camera.K[1, 2]
    seen = front & (x > 0.0) & (x < camera.width) & (y > 0.0) & (y < camera.height)
    column = np.clip(x, 0, camera.width - 1).astype(np.int64)
    row = np.clip(y, 0, camera.height - 1).astype(np.int64)
    seen &= np.abs(source.depth[row, column] - z) <= SAME_DEPTH * np.abs(z)
    seen &= source.usable[row, column]
    # grid_sample counts from -1 to 1 between the picture's outer edges.
    grid = np.stack([2.0 * x / camera.width - 1.0, 2.0 * y / camera.height - 1.0], axis=-1)
    grid = np.where(seen[..., None], grid, 2.0).astype(np.float32)
    color = F.grid_sample(
        torch.from_numpy(source.color).permute(2, 0, 1)[None],
        torch.from_numpy(grid)[None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )[0].permute(1, 2, 0)
    cosine = np.sum(here * _directions(points, camera.centre), axis=-1)
    angle = np.where(seen, np.arccos(np.clip(cosine, -1.0, 1.0)), np.pi).astype(np.float32)
    return np.where(seen[..., None], color.numpy(), np.float32(0.0)), angle
