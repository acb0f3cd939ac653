"""Photos warped to a render: the colours that they show at the surface in each of its pixels."""

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

#: A photo sees a point if the depth rendered from the photo differs from the point's by no more
#: than this part of it.
SAME_DEPTH = 0.03
#: Of more photos, those whose directions to the middle of the surface are nearest are looked up.
CONSIDERED = 8
#: Stands for the cosine of an angle where a photo does not see a point.
NOT_VISIBLE = -2.0
#: Below this alpha a render has no surface to look up.
SURFACE_ALPHA = 0.5
#: So many pixels are looked up at a time, in whole rows. Each takes some 300 bytes meanwhile.
BAND = 1 << 20


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
    splats: Splats, views: Sequence[View], background: Sequence[float], backend: Backend = "auto"
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
    """Look up each pixel's surface in the photos; keep those with the nearest directions.

    Args:
        camera: of the render.
        depth: [H, W], mean z along its axis, world units.
        alpha: [H, W]; pixels below ``SURFACE_ALPHA`` show no surface.
        sources: the photos; their order does not matter but among equal angles.
        keep: photos kept per pixel, K; where fewer see it, the rest is not valid.
    """
    height, width = depth.shape
    angle = np.full((keep, height, width), np.pi, np.float32)
    color = np.zeros((keep, height, width, 3), np.float32)
    surface = alpha > SURFACE_ALPHA
    points = _surface_points(camera, depth, surface)
    near = _nearest(sources, camera, points)
    done = 0
    for top in range(0, height if near else 0, max(1, BAND // width)):
        rows = slice(top, top + max(1, BAND // width))
        shown = surface[rows]
        count = int(shown.sum())
        if count:
            band = _best(near, camera, points[:, done : done + count], keep)
            for k, (colors, angles) in enumerate(band):
                color[k, rows][shown], angle[k, rows][shown] = colors, angles
        done += count
    return Warped(color, angle < np.float32(np.pi), angle)


def _best(
    near: Sequence[Source], camera: Camera, points: Tensor, keep: int
) -> list[tuple[Float32, Float32]]:
    """Colours [N, 3] and angles [N] of ``points`` in the photos, the nearest direction first."""
    cosines, at = zip(*(_looked_up(source, camera, points) for source in near), strict=True)
    best = torch.stack(cosines).topk(min(keep, len(near)), dim=0)
    out = []
    for cosine, photo in zip(best.values, best.indices, strict=True):
        found = torch.zeros(points.shape[1], 3)
        for index, source in enumerate(near):
            chosen = torch.nonzero((photo == index) & (cosine > NOT_VISIBLE))[:, 0]
            found[chosen] = _colors(source, at[index][:, chosen])
        seen = torch.where(cosine > NOT_VISIBLE, cosine.clamp(-1.0, 1.0).acos(), torch.pi)
        out.append((found.numpy(), seen.numpy()))
    return out


def _nearest(sources: Sequence[Source], camera: Camera, points: Tensor) -> list[Source]:
    """The ``CONSIDERED`` sources that look at the middle of ``points`` from nearest."""
    if len(sources) <= CONSIDERED or not points.shape[1]:
        return list(sources)
    to_world = np.linalg.inv(camera.viewmat)
    middle = to_world[:3, :3] @ points.median(dim=1).values.double().numpy() + to_world[:3, 3]
    here = _direction(camera, middle)
    cosines = [float(_direction(source.camera, middle) @ here) for source in sources]
    order = np.argsort(-np.array(cosines), kind="stable")[:CONSIDERED]
    return [sources[i] for i in sorted(order)]


def _direction(camera: Camera, point: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    direction: npt.NDArray[np.float64] = point - camera.center
    return direction / max(float(np.linalg.norm(direction)), 1e-30)


def _surface_points(camera: Camera, depth: Float32, surface: npt.NDArray[np.bool_]) -> Tensor:
    """Points [3, N] at the pixels where ``surface`` is, in the camera's axes."""
    rows, columns = np.nonzero(surface)
    K = camera.K
    x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    rays = np.stack([x, y, np.ones_like(x)])
    return torch.from_numpy((rays * depth[surface]).astype(np.float32))


def _looked_up(source: Source, camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine [N] between the directions or ``NOT_VISIBLE``, and pixels [2, N] in the photo."""
    photo = source.camera
    # Points stay in a camera's axes: float32 has no room for a scene far from the world's origin.
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
    there = torch.from_numpy(source.depth).reshape(-1)[pixel]
    seen &= (there - z).abs() <= SAME_DEPTH * z.abs()
    seen &= torch.from_numpy(source.usable).reshape(-1)[pixel]
    lengths = _dot(inside, inside) * _dot(turned, turned)
    cosine = _dot(inside, turned) * lengths.clamp_min(1e-30).rsqrt()
    return torch.where(seen, cosine, NOT_VISIBLE), torch.stack([x, y])


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _colors(source: Source, at: Tensor) -> Tensor:
    """A photo's colours [N, 3] at ``at`` [2, N], pixels."""
    # grid_sample counts from -1 to 1 between the picture's outer edges.
    size = torch.tensor([source.camera.width, source.camera.height])
    found: Tensor = F.grid_sample(
        torch.from_numpy(source.color).permute(2, 0, 1)[None],
        (2.0 * at.T / size - 1.0)[None, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return found[0, :, 0].T
