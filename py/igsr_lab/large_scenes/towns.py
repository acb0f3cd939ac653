"""Photos of a made-up town with known cameras: houses on a textured ground, ray-cast in numpy.

World axes as COLMAP's photos of it would have them: y points down, the ground is y = 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from igsr.capture import Camera, Capture, Points, View
from igsr.capture.types import Tracks, intrinsic_matrix
from igsr.capture.write_colmap import write_colmap

#: Units from the middle of one house to the next one's, and half the length of a house's wall.
APART, HALF = 5.0, 1.0
#: Texels per unit, and the color of the sky.
TEXELS, SKY = 2.5, (150.0, 190.0, 235.0)


def houses(columns: int, rows: int) -> np.ndarray:
    """float64 [N, 2, 3]: lowest and highest corner of each house."""
    random = np.random.default_rng(0)
    boxes = []
    for column in range(columns):
        for row in range(rows):
            x, z = APART * column, APART * row
            height = random.uniform(1.2, 2.6)
            boxes.append([[x - HALF, -height, z - HALF], [x + HALF, 0.0, z + HALF]])
    return np.array(boxes)


def cameras(columns: int, rows: int, each: int, width: int, height: int) -> list[Camera]:
    """Cameras in a ring around each house, looking at it; what is behind it shows, too."""
    random = np.random.default_rng(1)
    found = []
    for low, high in houses(columns, rows):
        middle = 0.5 * (low + high)
        for number in range(each):
            angle = 2.0 * np.pi * (number + random.uniform(0.0, 0.5)) / each
            away = 3.2 + random.uniform(-0.3, 0.3)
            center = middle + [away * np.sin(angle), 0.0, away * np.cos(angle)]
            center[1] = -1.9 + random.uniform(-0.4, 0.4)
            found.append(looking(center, middle, 0.9 * width, width, height))
    return found


def looking(
    center: np.ndarray, target: np.ndarray, focal: float, width: int, height: int
) -> Camera:
    """A level camera that looks from one place to another; its focal length is in pixels."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, np.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return Camera(viewmat, intrinsic_matrix(focal, focal, width / 2, height / 2), width, height)


def seen(boxes: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [R] along rays to what they meet, and which house it is: -1 ground, -2 sky."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(rays[:, 1] > 1e-9, -origins[:, 1] / rays[:, 1], np.inf)
        hit = np.where(np.isfinite(distance), -1, -2)
        for number, (low, high) in enumerate(boxes):
            near, far = (low - origins) / rays, (high - origins) / rays
            enter = np.minimum(near, far).max(axis=1)
            leave = np.maximum(near, far).min(axis=1)
            inside = (enter > 0.0) & (enter < leave) & (enter < distance)
            distance[inside], hit[inside] = enter[inside], number
    return distance, hit


def texture(seed: int, size: int = 256) -> np.ndarray:
    """float64 [size, size, 3] in 0..255: blotches of several sizes."""
    random = np.random.default_rng(seed)
    total = np.zeros((size, size, 3))
    for cell in (2, 4, 8, 16):
        noise = random.uniform(-1.0, 1.0, (size // cell, size // cell, 3))
        total += np.repeat(np.repeat(noise, cell, axis=0), cell, axis=1) * np.sqrt(cell)
    return np.clip(128.0 + 25.0 * total, 0.0, 255.0)


def colors(boxes: np.ndarray, places: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """float64 [R, 3] in 0..255 of places on what was hit."""
    out = np.tile(np.array(SKY), (len(hit), 1))
    for number in np.unique(hit[hit >= -1]):
        mine = hit == number
        at = places[mine]
        texels = texture(int(number) + 2)
        if number == -1:
            u, v = at[:, 0], at[:, 2]
        else:
            low, high = boxes[number]
            gap = np.minimum(np.abs(at - low), np.abs(at - high))
            face = gap.argmin(axis=1)
            u = np.where(face == 0, at[:, 2], at[:, 0])
            v = np.where(face == 1, at[:, 2], at[:, 1])
            v = v + 7.0 * face
        row, column = (np.floor(TEXELS * one).astype(np.int64) % len(texels) for one in (v, u))
        out[mine] = texels[row, column]
    return out


def photo(boxes: np.ndarray, camera: Camera, sharp: int = 2) -> np.ndarray:
    """uint8 [H, W, 3]: the town as a camera sees it, ``sharp`` squared rays a pixel."""
    width, height = camera.width, camera.height
    x, y = np.meshgrid(
        (np.arange(sharp * width) + 0.5) / sharp, (np.arange(sharp * height) + 0.5) / sharp
    )
    K = camera.K
    x, y = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ camera.viewmat[:3, :3]
    origins = np.broadcast_to(camera.center, rays.shape)
    distance, hit = seen(boxes, origins, rays)
    places = origins + np.where(hit >= -1, distance, 0.0)[:, None] * rays
    fine = colors(boxes, places, hit).reshape(height, sharp, width, sharp, 3)
    return np.clip(np.rint(fine.mean(axis=(1, 3))), 0, 255).astype(np.uint8)


def town(
    columns: int,
    rows: int,
    each: int,
    width: int = 64,
    height: int = 48,
    points: int = 400,
    sharp: int = 2,
) -> Capture:
    """A capture of a town of so many houses, with ``each`` photos of each; points have tracks.

    Args:
        columns, rows: houses along x and z.
        each: photos around each house.
        width, height: of the photos, pixels.
        points: for each house, on it and on the ground around it.
        sharp: the root of the rays of a pixel.
    """
    boxes = houses(columns, rows)
    views = [
        View(f"images/{number:04d}.png", camera, "train", photo(boxes, camera, sharp))
        for number, camera in enumerate(cameras(columns, rows, each, width, height))
    ]
    return Capture(Path("town"), views, points_of(boxes, views, points))


def points_of(boxes: np.ndarray, views: list[View], each: int, paint=colors) -> Points:
    """Points on houses and on the ground around them, with tracks of all views that see them.

    Args:
        boxes: the houses.
        views: whose photos see them.
        each: for each house.
        paint: colors of places on what was hit, as ``colors`` has them.
    """
    random = np.random.default_rng(2)
    places, owners = [], []
    for number, (low, high) in enumerate(boxes):
        on = random.uniform(low, high, (each, 3))
        face = random.integers(0, 5, each)
        for axis, side, which in ((0, 0, 0), (0, 1, 1), (2, 0, 2), (2, 1, 3), (1, 0, 4)):
            on[face == which, axis] = (low, high)[side][axis]
        ground = random.uniform(low - 3.0, high + 3.0, (each // 2, 3))
        ground[:, 1] = 0.0
        ground = ground[~((ground > low - [0, 1, 0]) & (ground < high + [0, 1, 0])).all(axis=1)]
        places += [on, ground]
        owners += [np.full(len(on), number), np.full(len(ground), -1)]
    xyz, owner = np.concatenate(places), np.concatenate(owners)
    view, point, xy = [], [], []
    for index, one in enumerate(views):
        camera = one.camera
        local = xyz @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        ahead = local[:, 2] > 0.1
        pixel = local @ camera.K.T
        pixel = pixel[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
        inside = ahead & (pixel > 0.0).all(axis=1) & (pixel < [camera.width, camera.height]).all(1)
        those = np.flatnonzero(inside)
        rays = xyz[those] - camera.center
        origins = np.broadcast_to(camera.center, rays.shape)
        distance, _ = seen(boxes, origins, rays)
        those = those[distance > 0.999]
        view.append(np.full(len(those), index))
        point.append(those)
        xy.append(pixel[those])
    tracks = Tracks([v.name for v in views], *map(np.concatenate, (view, point, xy)))
    return Points(xyz, np.clip(paint(boxes, xyz, owner), 0, 255).astype(np.uint8), tracks=tracks)


def written(capture: Capture, folder: Path) -> Path:
    """The capture as a COLMAP folder on disk."""
    write_colmap(capture, folder)
    return folder
