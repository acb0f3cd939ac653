"""Skies: distant light and backgrounds.

Each function of ``SKIES`` draws a map of linear RGB radiance, equirectangular [H, W, 3] with the
zenith in row 0, about as bright as an overcast sky of radiance 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from igsr_lab.synth.textures import hsv, noise, octaves, to_linear

#: Rows of a detailed map; it has twice the columns.
ROWS = 256


def _directions(rows: int) -> np.ndarray:
    """Unit vectors through the centers of all pixels, [rows, 2 rows, 3]."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    around = (np.arange(2 * rows) + 0.5) / rows * np.pi
    ring = np.sin(polar)[:, None]
    return np.stack(
        [ring * np.cos(around), ring * np.sin(around), np.cos(polar)[:, None] + 0 * around], -1
    )


def _tint(rng: np.random.Generator, strength: float) -> np.ndarray:
    """Warm or cold white, sometimes a color; [3] with mean 1."""
    hue = rng.choice([0.09, 0.6, rng.random()], p=[0.45, 0.45, 0.1])
    color = to_linear(hsv(hue, strength * rng.random(), 1.0))
    return np.asarray(color / color.mean())


def even(rng: np.random.Generator) -> np.ndarray:
    """The same light from all directions."""
    return np.broadcast_to(_tint(rng, 0.3), (4, 8, 3)).copy()


def gradient(rng: np.random.Generator) -> np.ndarray:
    """A gradient from the zenith over the horizon to the ground."""
    up = _directions(32)[..., 2:]
    zenith, horizon = _tint(rng, 0.6), _tint(rng, 0.4)
    ground = 0.4 * rng.random() * _tint(rng, 0.4)
    above = horizon + (rng.uniform(0.5, 1.6) * zenith - horizon) * np.clip(up, 0, 1) ** 0.6
    below = horizon + (ground - horizon) * np.clip(-4.0 * up, 0, 1)
    return np.where(up > 0.0, above, below)


def cloudy(rng: np.random.Generator) -> np.ndarray:
    """A sky with clouds and a hazy sun, over hills."""
    ways = _directions(ROWS)
    up = ways[..., 2]
    blue = to_linear(hsv(rng.uniform(0.53, 0.63), rng.uniform(0.2, 0.75), 0.95))
    pale = to_linear(hsv(rng.choice([0.08, 0.58]), rng.uniform(0.0, 0.4), 1.0))
    sky = pale + (blue - pale) * np.clip(up, 0, 1)[..., None] ** 0.5
    cover = octaves(rng, 2 * ROWS, 6, 6)[: 2 * ROWS : 2]  # stretched along the horizon
    amount = np.clip((cover - rng.uniform(0.35, 0.65)) * rng.uniform(2.0, 6.0), 0.0, 1.0)
    sky = sky + (rng.uniform(0.6, 1.2) - sky) * amount[..., None]
    azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 0.95)
    sun = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.sqrt(1 - height**2)
    sun[2] = height
    # The sun is blurred by haze: a sharp one would need many more light paths.
    glow = np.exp((ways @ sun - 1.0) / rng.uniform(0.003, 0.02))
    sky = sky + rng.uniform(5.0, 40.0) * (1.0 - 0.7 * amount[..., None]) * (
        glow[..., None] * to_linear(np.array([1.0, 0.93, 0.82]))
    )
    return _with_hills(rng, sky, up)


def _with_hills(rng: np.random.Generator, sky: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Ranges of hills around the horizon; below it the ground of the last one."""
    columns = sky.shape[1]
    hue = rng.uniform(0.05, 0.4)
    for step in range(3):
        ridge = 0.16 - 0.07 * step + 0.2 * (octaves(rng, columns, 4, 6)[0] - 0.5)
        color = to_linear(hsv(hue + 0.04 * step, 0.25 + 0.15 * step, 0.6 - 0.12 * step))
        grain = 0.6 + 0.8 * octaves(rng, columns, 32, 3)[: 2 * len(up) : 2]
        hill = color * grain[..., None]
        sky = np.where((up < ridge[None, :])[..., None], hill, sky)
    return sky


def studio(rng: np.random.Generator) -> np.ndarray:
    """Soft boxes before a dark wall."""
    ways = _directions(64)
    light = rng.uniform(0.1, 0.5) * np.broadcast_to(_tint(rng, 0.3), ways.shape).copy()
    for _ in range(int(rng.integers(2, 6))):
        towards = rng.normal(size=3) + [0, 0, 0.7]
        towards /= np.linalg.norm(towards)
        side = np.cross(towards, [0.0, 0.0, 1.0])
        side /= max(float(np.linalg.norm(side)), 1e-6)
        high = np.cross(side, towards)
        front = ways @ towards
        wide, tall = rng.uniform(0.2, 0.8, 2)
        edge = np.maximum(np.abs(ways @ side) / wide, np.abs(ways @ high) / tall)
        soft = np.clip((1.1 - edge / np.maximum(front, 1e-3)) * 6.0, 0.0, 1.0) * (front > 0.0)
        light += rng.uniform(1.5, 6.0) * soft[..., None] * _tint(rng, 0.5)
    return light


def interior(rng: np.random.Generator) -> np.ndarray:
    """A distant hall: windows, doors, cupboards and lamps as blurred rectangles."""
    columns = 2 * ROWS
    base = to_linear(hsv(rng.random(), rng.uniform(0.0, 0.35), rng.uniform(0.4, 0.8)))
    picture = base * (0.7 + 0.5 * octaves(rng, columns, 4, 5)[:columns:2])[..., None]
    picture[: int(0.3 * ROWS)] = rng.uniform(0.6, 1.4) * _tint(rng, 0.2)
    for _ in range(int(rng.integers(15, 50))):
        x, wide = rng.integers(0, columns), rng.integers(6, 70)
        top = rng.integers(int(0.25 * ROWS), int(0.6 * ROWS))
        tall = rng.integers(10, 90)
        bright = rng.choice([0.3, 0.8, 4.0], p=[0.5, 0.35, 0.15])
        color = bright * to_linear(hsv(rng.random(), rng.uniform(0, 0.6), rng.uniform(0.3, 1.0)))
        picture[top : top + tall, np.arange(x, x + wide) % columns] = color
    floor = 0.4 * to_linear(hsv(rng.uniform(0.02, 0.15), rng.uniform(0.1, 0.6), 0.7))
    picture[int(0.66 * ROWS) :] = floor
    blur = int(rng.integers(1, 5))
    for axis in (0, 1):
        shifted = [np.roll(picture, shift, axis) for shift in range(-blur, blur + 1)]
        picture = np.mean(shifted, axis=0)
    grain = noise(rng, ROWS, columns, (64, 128))
    return picture * (0.85 + 0.3 * grain)[..., None]


#: Skies for lone objects, whose photos do not show them.
UNSEEN_SKIES: tuple[Callable[[np.random.Generator], np.ndarray], ...] = (even, gradient, studio)
#: Skies that photos may show.
SKIES: tuple[Callable[[np.random.Generator], np.ndarray], ...] = (gradient, cloudy, interior)
