"""Photos of a made-up room with known cameras: textured walls, ray-cast in numpy.

Structure from motion needs corners that look like themselves from elsewhere, which a few random
splats do not give.
"""

from __future__ import annotations

import numpy as np

from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.capture.types import intrinsic_matrix
from igsr_lab.large_scenes.towns import texture

#: Planes point . normal = offset, and two axes along each.
WALLS = (
    ((0.0, 0.0, 1.0), 4.0, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 1.0, 0.0), 1.0, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((-1.0, 0.0, 0.3), 3.0, (0.3, 0.0, 1.0), (0.0, 1.0, 0.0)),
    ((1.0, 0.0, 0.4), 3.0, (0.4, 0.0, -1.0), (0.0, 1.0, 0.0)),
)
TEXELS = 24.0


def camera(angle, focal=200.0, width=240, height=180):
    """A camera on an arc about the room's middle, looking at it; angle in radians."""
    middle = np.array([0.0, 0.0, 3.0])
    center = middle + 4.0 * np.array(
        [np.sin(angle), -0.1 + 0.1 * np.cos(7.0 * angle), -np.cos(angle)]
    )
    z = middle - center
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, np.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return Camera(viewmat, intrinsic_matrix(focal, focal, width / 2, height / 2), width, height)


def picture(camera, seed=0, k=0.0):
    """uint8 [H, W, 3]: the room of a seed as a camera sees it, four rays a pixel.

    Its lens puts a ray at radius r (1 + k r^2).
    """
    x, y = np.meshgrid(
        (np.arange(2 * camera.width) + 0.5) / 2.0, (np.arange(2 * camera.height) + 0.5) / 2.0
    )
    K = camera.K
    x, y = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
    bent_x, bent_y = x, y
    for _ in range(20):
        factor = 1.0 + k * (x * x + y * y)
        x, y = bent_x / factor, bent_y / factor
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ camera.viewmat[:3, :3]
    nearest = np.full(x.shape, np.inf)
    colors = np.zeros((*x.shape, 3))
    for wall, (normal, offset, along, up) in enumerate(WALLS):
        with np.errstate(divide="ignore"):
            distance = (offset - camera.center @ normal) / (rays @ np.array(normal))
        hit = (distance > 0.0) & (distance < nearest)
        nearest[hit] = distance[hit]
        places = camera.center + distance[hit][:, None] * rays[hit]
        texels = texture(10 * seed + wall)
        row, column = (
            np.floor(places @ np.array(axis) * TEXELS).astype(np.int64) % len(texels)
            for axis in (up, along)
        )
        colors[hit] = texels[row, column]
    height, width = camera.height, camera.width
    return np.rint(colors.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))).astype(np.uint8)


def photos(cameras, seed=0, k=0.0):
    """Photos of the room, named 0.png and so on."""
    return [Photo(f"{i}.png", picture(camera, seed, k)) for i, camera in enumerate(cameras)]


def depths(camera, pixels):
    """float64 [P]: z-depths of the room at pixels [P, 2] of a camera."""
    slopes = (pixels - camera.K[[0, 1], 2]) / camera.K[[0, 1], [0, 1]]
    rays = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0) @ camera.viewmat[:3, :3]
    nearest = np.full(len(rays), np.inf)
    for normal, offset, *_ in WALLS:
        with np.errstate(divide="ignore"):
            distance = (offset - camera.center @ normal) / (rays @ np.array(normal))
        nearest = np.where((distance > 0.0) & (distance < nearest), distance, nearest)
    return nearest


def depth(camera):
    """float32 [H, W]: z-depths of the room at all pixel centers of a camera."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    return depths(camera, pixels).reshape(x.shape).astype(np.float32)
