"""Photos of an artificial town with known cameras: houses on textured ground, ray-cast in numpy.

World axes are as COLMAP's: y points down, the ground is y = 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from igsr.capture import Camera, Capture, Points, View
from igsr.capture.types import Tracks, intrinsic_matrix
from igsr.capture.write_colmap import write_colmap

#: Distance between the centers of neighboring houses, world units.
HOUSE_DISTANCE = 5.0
#: Half the length of a house's wall, world units.
HALF_WALL = 1.0
TEXELS_PER_UNIT = 2.5
SKY = (150.0, 190.0, 235.0)
#: Numbers that stand for houses in hits.
GROUND_HIT, SKY_HIT = -1, -2


def houses(columns: int, rows: int) -> np.ndarray:
    """Lowest and highest corner of each house, float64 [N, 2, 3]."""
    random = np.random.default_rng(0)
    boxes = []
    for column in range(columns):
        for row in range(rows):
            x, z = HOUSE_DISTANCE * column, HOUSE_DISTANCE * row
            height = random.uniform(1.2, 2.6)
            low = [x - HALF_WALL, -height, z - HALF_WALL]
            boxes.append([low, [x + HALF_WALL, 0.0, z + HALF_WALL]])
    return np.array(boxes)


def cameras(columns: int, rows: int, each: int, width: int, height: int) -> list[Camera]:
    """Cameras in a ring around each house, looking at it."""
    random = np.random.default_rng(1)
    found = []
    for low, high in houses(columns, rows):
        middle = 0.5 * (low + high)
        for number in range(each):
            angle = 2.0 * np.pi * (number + random.uniform(0.0, 0.5)) / each
            away = 3.2 + random.uniform(-0.3, 0.3)
            center = middle + [away * np.sin(angle), 0.0, away * np.cos(angle)]
            center[1] = -1.9 + random.uniform(-0.4, 0.4)
            found.append(camera_at(center, middle, 0.9 * width, width, height))
    return found


def camera_at(
    center: np.ndarray, target: np.ndarray, focal: float, width: int, height: int
) -> Camera:
    """A level camera that looks at a target; focal length in pixels."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, np.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return Camera(viewmat, intrinsic_matrix(focal, focal, width / 2, height / 2), width, height)


def hits(boxes: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [R] along rays to the first hit, and the number of the house, ground or sky."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(rays[:, 1] > 1e-9, -origins[:, 1] / rays[:, 1], np.inf)
        hit = np.where(np.isfinite(distance), GROUND_HIT, SKY_HIT)
        for number, (low, high) in enumerate(boxes):
            near, far = (low - origins) / rays, (high - origins) / rays
            enter = np.minimum(near, far).max(axis=1)
            leave = np.maximum(near, far).min(axis=1)
            inside = (enter > 0.0) & (enter < leave) & (enter < distance)
            distance[inside], hit[inside] = enter[inside], number
    return distance, hit


def texture(seed: int, size: int = 256) -> np.ndarray:
    """Blotches of several sizes, float64 [size, size, 3] in 0..255."""
    random = np.random.default_rng(seed)
    total = np.zeros((size, size, 3))
    for cell in (2, 4, 8, 16):
        noise = random.uniform(-1.0, 1.0, (size // cell, size // cell, 3))
        total += np.repeat(np.repeat(noise, cell, axis=0), cell, axis=1) * np.sqrt(cell)
    return np.clip(128.0 + 25.0 * total, 0.0, 255.0)


def face_of(box: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Axis of the normal of a house's face, for places on it."""
    low, high = box
    return np.minimum(np.abs(places - low), np.abs(places - high)).argmin(axis=1)


def colors(boxes: np.ndarray, places: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Colors of hits, float64 [R, 3] in 0..255."""
    out = np.tile(np.array(SKY), (len(hit), 1))
    for number in np.unique(hit[hit >= GROUND_HIT]):
        mine = hit == number
        at = places[mine]
        texels = texture(int(number) + 2)
        if number == GROUND_HIT:
            u, v = at[:, 0], at[:, 2]
        else:
            face = face_of(boxes[number], at)
            u = np.where(face == 0, at[:, 2], at[:, 0])
            v = np.where(face == 1, at[:, 2], at[:, 1])
            v = v + 7.0 * face
        row, column = (np.floor(TEXELS_PER_UNIT * x).astype(np.int64) % len(texels) for x in (v, u))
        out[mine] = texels[row, column]
    return out


def photo(boxes: np.ndarray, camera: Camera, samples: int = 2, shade=None) -> np.ndarray:
    """Render the town, uint8 [H, W, 3], with ``samples`` squared rays per pixel.

    Args:
        boxes: the houses.
        camera: the camera.
        samples: rays per pixel along each axis.
        shade: colors from (boxes, places, hit, distance, rays); None is ``colors``.
    """
    width, height = camera.width, camera.height
    x, y = np.meshgrid(
        (np.arange(samples * width) + 0.5) / samples, (np.arange(samples * height) + 0.5) / samples
    )
    K = camera.K
    x, y = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ camera.viewmat[:3, :3]
    origins = np.broadcast_to(camera.center, rays.shape)
    distance, hit = hits(boxes, origins, rays)
    distance = np.where(hit >= GROUND_HIT, distance, 0.0)
    places = origins + distance[:, None] * rays
    if shade is None:
        fine = colors(boxes, places, hit)
    else:
        fine = shade(boxes, places, hit, distance, rays)
    fine = fine.reshape(height, samples, width, samples, 3)
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
    """A capture of a town with ``each`` photos of each house; points have tracks.

    Args:
        columns, rows: houses along x and z.
        each: photos around each house.
        width, height: of the photos, pixels.
        points: number of points per house, on it and on the ground around it.
        sharp: rays per pixel along each axis.
    """
    boxes = houses(columns, rows)
    return capture_of(
        boxes,
        cameras(columns, rows, each, width, height),
        lambda camera: photo(boxes, camera, sharp),
        points,
    )


def capture_of(boxes: np.ndarray, cameras: list[Camera], photo, points: int, paint=colors):
    """A capture with ``photo(camera)`` for each camera, and ``points`` points per house."""
    views = [
        View(f"images/{number:04d}.png", camera, "train", photo(camera))
        for number, camera in enumerate(cameras)
    ]
    return Capture(Path("town"), views, _points(boxes, views, points, paint))


def _points(boxes: np.ndarray, views: list[View], each: int, paint) -> Points:
    """Points on houses and on the ground around them, with tracks of all views that see them."""
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
        owners += [np.full(len(on), number), np.full(len(ground), GROUND_HIT)]
    xyz, owner = np.concatenate(places), np.concatenate(owners)
    view, point, xy = [], [], []
    for index, camera in enumerate(view.camera for view in views):
        local = xyz @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        ahead = local[:, 2] > 0.1
        pixel = local @ camera.K.T
        pixel = pixel[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
        inside = ahead & (pixel > 0.0).all(axis=1) & (pixel < [camera.width, camera.height]).all(1)
        visible = np.flatnonzero(inside)
        rays = xyz[visible] - camera.center
        distance, _ = hits(boxes, np.broadcast_to(camera.center, rays.shape), rays)
        visible = visible[distance > 0.999]
        view.append(np.full(len(visible), index))
        point.append(visible)
        xy.append(pixel[visible])
    tracks = Tracks([v.name for v in views], *map(np.concatenate, (view, point, xy)))
    return Points(xyz, np.clip(paint(boxes, xyz, owner), 0, 255).astype(np.uint8), tracks=tracks)


def written(capture: Capture, folder: Path) -> Path:
    """Write a capture as a COLMAP folder; return the folder."""
    write_colmap(capture, folder)
    return folder
