"""The town of ``towns`` with soft textures, windows and haze, like photos.

``towns`` has squares of pure colors, which splats cannot represent at small sizes. The photos are
taken by a drone; each shows 2 to 4 houses.
"""

from __future__ import annotations

import numpy as np

from igsr.capture import Camera, Capture
from igsr_lab.large_scenes import towns

#: Color of the sky at the horizon, and straight up.
HORIZON, ZENITH = np.array([200.0, 212.0, 225.0]), np.array([110.0, 150.0, 205.0])
#: Distance after which haze hides all but a third, world units.
HAZE_DISTANCE = 30.0
#: Size of the texture's coarsest waves, world units, and its number of octaves.
WAVE, OCTAVES = 4.0, 4
#: Side of a tile of the texture, in cells of its coarsest octave.
TILE_CELLS = 16
#: Number of points per house.
POINTS = 400


def noise(seed: int, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Smooth noise, float64 [R, 3], about -1 to 1; each octave has half the amplitude."""
    random = np.random.default_rng(seed)
    total = np.zeros((len(u), 3))
    for octave in range(OCTAVES):
        cells = TILE_CELLS << octave
        # Mainly gray, as surfaces are.
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
    """Colors of hits, float64 [R, 3] in 0..255; the sky is black."""
    out = np.zeros((len(hit), 3))
    paint = np.random.default_rng(7).uniform(95.0, 205.0, (len(boxes), 3))
    for number in np.unique(hit[hit >= towns.GROUND_HIT]):
        mine = hit == number
        at = places[mine]
        if number == towns.GROUND_HIT:
            out[mine] = np.array([118.0, 122.0, 104.0]) + 55.0 * noise(2, at[:, 0], at[:, 2])
            continue
        low = boxes[number][0]
        face = towns.face_of(boxes[number], at)
        along = np.where(face == 0, at[:, 2] - low[2], at[:, 0] - low[0])
        up = np.where(face == 1, at[:, 2] - low[2], at[:, 1] - low[1])
        base = np.where((face == 1)[:, None], np.array([140.0, 85.0, 70.0]), paint[number])
        light = np.choose(face, (0.8, 1.1, 1.0))[:, None]
        color = light * base + 40.0 * noise(int(number) + 3, along + 5.0 * face, up)
        # Two windows per wall and story.
        window = (face != 1) & (np.abs(along % 1.0 - 0.5) < 0.2) & (np.abs(up % 0.9 - 0.45) < 0.2)
        color[window] = np.array([50.0, 60.0, 75.0])
        out[mine] = color
    return out


def _hazy(boxes, places, hit, distance, rays) -> np.ndarray:
    """Colors of hits, faded into the sky by distance."""
    length = np.linalg.norm(rays, axis=1)
    up = np.clip(-rays[:, 1] / length, 0.0, 1.0)[:, None]
    sky = HORIZON + (ZENITH - HORIZON) * up
    clear = np.exp(-distance * length / HAZE_DISTANCE)
    clear = np.where(hit >= towns.GROUND_HIT, clear, 0.0)
    return sky + clear[:, None] * (colors(boxes, places, hit) - sky)


def drone(columns: int, rows: int, count: int, width: int, height: int) -> list[Camera]:
    """Cameras above the town, evenly spread, that look down at the ground ahead.

    No photo shows the sky, which would be reconstructed differently by each fit.
    """
    random = np.random.default_rng(3)
    low = -0.6 * towns.HOUSE_DISTANCE
    across, along = (towns.HOUSE_DISTANCE * (n - 1) - 2.0 * low for n in (columns, rows))
    side = max(1, round((count * across / along) ** 0.5))
    found = []
    for number in range(count):
        column, row = number % side, number // side
        x = low + across * (column + random.uniform()) / side
        z = low + along * (row + random.uniform()) / (-(-count // side))
        up, turn = random.uniform(3.6, 4.4), random.uniform(0.0, 2.0 * np.pi)
        away = up / np.tan(np.radians(random.uniform(50.0, 65.0)))
        target = np.array([x + away * np.sin(turn), 0.0, z + away * np.cos(turn)])
        found.append(towns.camera_at(np.array([x, -up, z]), target, 0.9 * width, width, height))
    return found


def soft_town(columns: int, rows: int, count: int, width: int, height: int) -> Capture:
    """A capture of a town from above, with points that have tracks."""
    boxes = towns.houses(columns, rows)
    return towns.capture_of(
        boxes,
        drone(columns, rows, count, width, height),
        lambda camera: towns.photo(boxes, camera, shade=_hazy),
        POINTS,
        colors,
    )
