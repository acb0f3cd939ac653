"""The town of ``towns`` made to look like photos: soft textures, windows, haze.

``towns`` has square patches of pure colors, which splats cannot show at small sizes. Photos are
taken by a drone, 2 to 4 houses each.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from igsr.capture import Camera, Capture, View
from igsr_lab.large_scenes import towns

#: Color of the sky at the horizon, and straight up.
HORIZON, ZENITH = np.array([200.0, 212.0, 225.0]), np.array([110.0, 150.0, 205.0])
#: Units after which haze hides all but a third.
HAZE = 30.0
#: Units of the texture's coarsest waves, and how many octaves finer ones follow.
WAVE, OCTAVES = 4.0, 4
#: Side of a tile of the texture, in cells of its coarsest octave.
TILE = 16


def noise(seed: int, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """float64 [R, 3], about -1 to 1: smooth noise, each octave half as strong as the one before."""
    random = np.random.default_rng(seed)
    total = np.zeros((len(u), 3))
    for octave in range(OCTAVES):
        cells = TILE << octave
        # Grey for the most part, as surfaces are.
        grid = random.uniform(-1.0, 1.0, (cells, cells, 1)) + 0.3 * random.uniform(
            -1.0, 1.0, (cells, cells, 3)
        )
        x, y = (one / WAVE * 2.0**octave for one in (u, v))
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        x, y = (t * t * (3.0 - 2.0 * t) for t in (x - column, y - row))
        c0, c1, r0, r1 = (k % cells for k in (column, column + 1, row, row + 1))
        x, y = x[:, None], y[:, None]
        low = grid[r0, c0] * (1.0 - x) + grid[r0, c1] * x
        high = grid[r1, c0] * (1.0 - x) + grid[r1, c1] * x
        total += 0.5**octave * (low * (1.0 - y) + high * y)
    return total / 2.0


def colors(boxes: np.ndarray, places: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """float64 [R, 3] in 0..255 of places on what was hit; the sky is black here."""
    out = np.zeros((len(hit), 3))
    paint = np.random.default_rng(7).uniform(95.0, 205.0, (len(boxes), 3))
    for number in np.unique(hit[hit >= -1]):
        mine = hit == number
        at = places[mine]
        if number == -1:
            out[mine] = np.array([118.0, 122.0, 104.0]) + 55.0 * noise(2, at[:, 0], at[:, 2])
            continue
        low, high = boxes[number]
        gap = np.minimum(np.abs(at - low), np.abs(at - high))
        face = gap.argmin(axis=1)
        along = np.where(face == 0, at[:, 2] - low[2], at[:, 0] - low[0])
        up = np.where(face == 1, at[:, 2] - low[2], at[:, 1] - low[1])
        base = np.where((face == 1)[:, None], np.array([140.0, 85.0, 70.0]), paint[number])
        light = np.choose(face, (0.8, 1.1, 1.0))[:, None]
        color = light * base + 40.0 * noise(int(number) + 3, along + 5.0 * face, up)
        # Two windows a wall and storey.
        window = (face != 1) & (np.abs(along % 1.0 - 0.5) < 0.2) & (np.abs(up % 0.9 - 0.45) < 0.2)
        color[window] = np.array([50.0, 60.0, 75.0])
        out[mine] = color
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
    distance, hit = towns.seen(boxes, origins, rays)
    length = np.linalg.norm(rays, axis=1)
    places = origins + np.where(hit >= -1, distance, 0.0)[:, None] * rays
    up = np.clip(-rays[:, 1] / length, 0.0, 1.0)[:, None]
    sky = HORIZON + (ZENITH - HORIZON) * up
    clear = np.where(hit >= -1, np.exp(-np.where(hit >= -1, distance, 0.0) * length / HAZE), 0.0)
    fine = sky + clear[:, None] * (colors(boxes, places, hit) - sky)
    fine = fine.reshape(height, sharp, width, sharp, 3)
    return np.clip(np.rint(fine.mean(axis=(1, 3))), 0, 255).astype(np.uint8)


def drone(columns: int, rows: int, count: int, width: int, height: int) -> list[Camera]:
    """Cameras above the town, evenly spread, that look down at the ground before them.

    No photo shows the sky, which has no place: what stands for it is another scene in each fit.
    """
    random = np.random.default_rng(3)
    low = -0.6 * towns.APART
    across, along = (towns.APART * (n - 1) - 2.0 * low for n in (columns, rows))
    side = max(1, round((count * across / along) ** 0.5))
    found = []
    for number in range(count):
        column, row = number % side, number // side
        x = low + across * (column + random.uniform()) / side
        z = low + along * (row + random.uniform()) / (-(-count // side))
        up, turn = random.uniform(3.6, 4.4), random.uniform(0.0, 2.0 * np.pi)
        away = up / np.tan(np.radians(random.uniform(50.0, 65.0)))
        target = np.array([x + away * np.sin(turn), 0.0, z + away * np.cos(turn)])
        found.append(towns.looking(np.array([x, -up, z]), target, 0.9 * width, width, height))
    return found


def soft_town(columns: int, rows: int, count: int, width: int, height: int) -> Capture:
    """A capture of a town of so many houses from above, with points that have tracks."""
    boxes = towns.houses(columns, rows)
    views = [
        View(f"images/{number:04d}.png", camera, "train", photo(boxes, camera))
        for number, camera in enumerate(drone(columns, rows, count, width, height))
    ]
    return Capture(Path("town"), views, towns.points_of(boxes, views, 400, colors))
