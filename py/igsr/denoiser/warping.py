"""Warp photos to a render: look up the colors that they show at each pixel's surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from igsr._internal.choices import Backend
from igsr.capture import Camera, View
from igsr.evaluation.scores import over_background
from igsr.rendering.renders import render
from igsr.splats import Splats

Float32 = npt.NDArray[np.float32]

#: A photo sees a point if its rendered depth there differs by at most this fraction of the depth.
DEPTH_TOLERANCE = 0.03
#: Maximum number of photos to look up, by the similarity of their direction to the surface.
MAX_SOURCES = 8
#: Marks points that a photo does not see, in arrays of cosines.
NOT_VISIBLE = -2.0
#: Pixels of a lower alpha have no surface.
SURFACE_ALPHA = 0.5
#: Pixels to look up at a time, in whole rows; each takes about 300 bytes.
BAND_PIXELS = 1 << 20


@dataclass(frozen=True, eq=False)
class Source:
    """A photo to look up colors in.

    Attributes:
        camera: of the photo, OpenCV axes, world frame.
        color: float32 [H, W, 3] in [0, 1], over the background.
        usable: bool [H, W], False in masked pixels.
        depth: float32 [H, W], rendered from the photo's camera, world units; 0 without a surface.
    """

    camera: Camera
    color: Float32
    usable: npt.NDArray[np.bool_]
    depth: Float32


@dataclass(frozen=True, eq=False)
class Warped:
    """Colors of K photos at a render's pixels, ordered by angle.

    Attributes:
        color: float32 [K, H, W, 3] in [0, 1], zero if not valid.
        valid: bool [K, H, W], whether at least k + 1 photos see the pixel's surface.
        angle: float32 [K, H, W], between the directions of photo and render to the surface,
            radians; pi if not valid.
    """

    color: Float32
    valid: npt.NDArray[np.bool_]
    angle: Float32


def photo_sources(
    splats: Splats, views: Sequence[View], background: Sequence[float], backend: Backend = "auto"
) -> list[Source]:
    """Prepare photos for look-up: render the depth of the scene from their cameras.

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
    """Look up each pixel's surface in the photos with the smallest angles.

    Args:
        camera: of the render.
        depth: [H, W], mean z along the camera's axis, world units.
        alpha: [H, W].
        sources: the photos.
        keep: number of photos to keep per pixel, K.
    """
    height, width = depth.shape
    angle = np.full((keep, height, width), np.pi, np.float32)
    color = np.zeros((keep, height, width, 3), np.float32)
    surface = alpha > SURFACE_ALPHA
    points = _surface_points(camera, depth, surface)
    near = _nearest(sources, camera, points)
    done = 0
    band_rows = max(1, BAND_PIXELS // width)
    for top in range(0, height if near else 0, band_rows):
        rows = slice(top, top + band_rows)
        pixels = surface[rows]
        count = int(pixels.sum())
        if count:
            band = _best(near, camera, points[:, done : done + count], keep)
            for k, (colors, angles) in enumerate(band):
                color[k, rows][pixels], angle[k, rows][pixels] = colors, angles
        done += count
    return Warped(color, angle < np.float32(np.pi), angle)


def _best(
    near: Sequence[Source], camera: Camera, points: Tensor, keep: int
) -> list[tuple[Float32, Float32]]:
    """Colors [N, 3] and angles [N] of ``points`` in the photos, the smallest angle first."""
    cosines, pixels = zip(*(_visible(source, camera, points) for source in near), strict=True)
    best = torch.stack(cosines).topk(min(keep, len(near)), dim=0)
    out = []
    for cosine, photo in zip(best.values, best.indices, strict=True):
        colors = torch.zeros(points.shape[1], 3)
        for index, source in enumerate(near):
            chosen = torch.nonzero((photo == index) & (cosine > NOT_VISIBLE))[:, 0]
            colors[chosen] = _colors(source, pixels[index][:, chosen])
        angles = torch.where(cosine > NOT_VISIBLE, cosine.clamp(-1.0, 1.0).acos(), torch.pi)
        out.append((colors.numpy(), angles.numpy()))
    return out


def _nearest(sources: Sequence[Source], camera: Camera, points: Tensor) -> list[Source]:
    """The ``MAX_SOURCES`` sources with the smallest angles at the median point."""
    if len(sources) <= MAX_SOURCES or not points.shape[1]:
        return list(sources)
    to_world = np.linalg.inv(camera.viewmat)
    median = to_world[:3, :3] @ points.median(dim=1).values.double().numpy() + to_world[:3, 3]
    here = _direction(camera, median)
    cosines = [float(_direction(source.camera, median) @ here) for source in sources]
    order = np.argsort(-np.array(cosines), kind="stable")[:MAX_SOURCES]
    return [sources[i] for i in sorted(order)]


def _direction(camera: Camera, point: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    direction: npt.NDArray[np.float64] = point - camera.centre
    return direction / max(float(np.linalg.norm(direction)), 1e-30)


def _surface_points(camera: Camera, depth: Float32, surface: npt.NDArray[np.bool_]) -> Tensor:
    """Points [3, N] of the pixels in ``surface``, in the camera's axes."""
    rows, columns = np.nonzero(surface)
    K = camera.K
    x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    rays = np.stack([x, y, np.ones_like(x)])
    return torch.from_numpy((rays * depth[surface]).astype(np.float32))


def _visible(source: Source, camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine [N] between the directions or ``NOT_VISIBLE``, and pixels [2, N] in the photo."""
    photo = source.camera
    # In the cameras' axes: float32 is too coarse for a scene far from the world's origin.
    between = torch.from_numpy(photo.viewmat @ np.linalg.inv(camera.viewmat)).float()
    turned = between[:3, :3] @ points
    inside = turned + between[:3, 3:]
    z = inside[2]
    front = z > 1e-6 * points[2]
    inverse = 1.0 / torch.where(front, z, 1.0)
    x = float(photo.K[0, 0]) * inside[0] * inverse + float(photo.K[0, 2])
    y = float(photo.K[1, 1]) * inside[1] * inverse + float(photo.K[1, 2])
    seen = front & (x > 0.0) & (x < photo.width) & (y > 0.0) & (y < photo.height)
    pixel = torch.where(seen, y, 0.0).long() * photo.width + torch.where(seen, x, 0.0).long()
    rendered = torch.from_numpy(source.depth).reshape(-1)[pixel]
    seen &= (rendered - z).abs() <= DEPTH_TOLERANCE * z.abs()
    seen &= torch.from_numpy(source.usable).reshape(-1)[pixel]
    lengths = _dot(inside, inside) * _dot(turned, turned)
    cosine = _dot(inside, turned) * lengths.clamp_min(1e-30).rsqrt()
    return torch.where(seen, cosine, NOT_VISIBLE), torch.stack([x, y])


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _colors(source: Source, pixels: Tensor) -> Tensor:
    """Colors [N, 3] of a photo at ``pixels`` [2, N], interpolated."""
    # grid_sample counts from -1 to 1 between the picture's outer edges.
    size = torch.tensor([source.camera.width, source.camera.height])
    colors: Tensor = F.grid_sample(
        torch.from_numpy(source.color).permute(2, 0, 1)[None],
        (2.0 * pixels.T / size - 1.0)[None, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return colors[0, :, 0].T
