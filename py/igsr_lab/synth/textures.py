"""Random textures: sRGB in [0, 1], float64 [H, W, 3]; most are seamless."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont


def noise(rng: np.random.Generator, height: int, width: int, cells: tuple[int, int]) -> np.ndarray:
    """Smooth seamless noise in [0, 1]: cosine-blended random values."""
    grid = rng.random(cells)
    rows = np.arange(height) / height * cells[0]
    columns = np.arange(width) / width * cells[1]
    r0, c0 = rows.astype(int), columns.astype(int)
    r1, c1 = (r0 + 1) % cells[0], (c0 + 1) % cells[1]
    blend_r = (0.5 - 0.5 * np.cos(np.pi * (rows - r0)))[:, None]
    blend_c = (0.5 - 0.5 * np.cos(np.pi * (columns - c0)))[None, :]
    top = grid[np.ix_(r0, c0)] * (1 - blend_c) + grid[np.ix_(r0, c1)] * blend_c
    bottom = grid[np.ix_(r1, c0)] * (1 - blend_c) + grid[np.ix_(r1, c1)] * blend_c
    return top * (1 - blend_r) + bottom * blend_r


def mix(a: Any, b: Any, amount: np.ndarray) -> np.ndarray:
    amount = np.asarray(amount)[..., None]
    return np.asarray(a) * (1 - amount) + np.asarray(b) * amount


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Convert linear light in [0, 1] to sRGB (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """sRGB [3] of a hue (turns, any number), saturation and value in [0, 1]."""
    offset = (np.array([5.0, 3.0, 1.0]) + 6.0 * hue) % 6.0
    return value - value * saturation * np.clip(np.minimum(offset, 4.0 - offset), 0.0, 1.0)


def palette(rng: np.random.Generator, vividness: float) -> np.ndarray:
    """Draw matching sRGB colors, [8, 3]: one or two hues, neutrals, an accent.

    ``vividness`` is the probability that all except the neutrals are saturated.
    """
    hue = rng.random()
    second = hue + rng.choice([0.05, -0.08, 0.33, 0.5])
    vivid = rng.random() < vividness
    colors = []
    for index in range(8):
        if index < 2:
            warmth = rng.choice([0.09, 0.6])
            colors.append(hsv(warmth, rng.uniform(0.0, 0.2), rng.uniform(0.2, 0.95)))
            continue
        base = hue if index < 5 else second if index < 7 else rng.random()
        saturation = rng.uniform(0.5, 0.95) if vivid or index == 7 else rng.uniform(0.05, 0.5)
        colors.append(hsv(base + rng.normal(0.0, 0.03), saturation, rng.uniform(0.2, 1.0) ** 0.7))
    return np.array(colors)


def octaves(
    rng: np.random.Generator, size: int, cells: int, levels: int = 4, stretch: int = 1
) -> np.ndarray:
    """Sum of noises, [size, size] in [0, 1], each of half the weight and twice the cells.

    Args:
        rng: draws the noise.
        size: rows and columns.
        cells: of the coarsest noise, along u.
        levels: number of noises.
        stretch: ratio of cells along v to cells along u.
    """
    total, weight, amount = np.zeros((size, size)), 0.0, 1.0
    for _ in range(levels):
        if cells * stretch > size:
            break
        total += amount * noise(rng, size, size, (cells * stretch, cells))
        weight += amount
        amount, cells = amount / 2, cells * 2
    low, high = total.min(), total.max()
    return (total - low) / max(high - low, 1e-9)


def _pick(rng: np.random.Generator, colors: np.ndarray, count: int) -> np.ndarray:
    return colors[rng.choice(len(colors), count, replace=False)]


def _grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """u along columns, v along rows, both [size, size] in [0, 1)."""
    steps = np.arange(size) / size
    u, v = np.meshgrid(steps, steps)
    return u, v


def _worn(rng: np.random.Generator, picture: np.ndarray, amount: float) -> np.ndarray:
    """Add blotches of dirt, so that no surface is a single flat color."""
    size = len(picture)
    blotches = octaves(rng, size, int(rng.integers(2, 8)), 5)
    return np.clip(picture * (1.0 - amount * blotches[..., None]), 0.0, 1.0)


def speckle(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """One color, unevenly applied, with fine grain."""
    (base,) = _pick(rng, colors, 1)
    grain = noise(rng, size, size, (size // 2, size // 2))
    return _worn(rng, base * (1.0 - 0.12 * grain[..., None]), rng.uniform(0.1, 0.35))


def clouds(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Three colors that run into each other."""
    a, b, c = _pick(rng, colors, 3)
    first = octaves(rng, size, int(rng.integers(2, 7)), 5)
    second = octaves(rng, size, int(rng.integers(2, 7)), 5)
    sharp = rng.uniform(1.0, 6.0)
    blend = np.clip((first - 0.5) * sharp + 0.5, 0.0, 1.0)
    return mix(mix(a, b, blend), c, np.clip((second - 0.55) * sharp, 0.0, 1.0))


def checker(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Squares of two colors."""
    a, b = _pick(rng, colors, 2)
    u, v = _grid(size)
    squares = 2 * int(rng.integers(2, 8))
    odd = ((u * squares).astype(int) + (v * squares).astype(int)) % 2
    return _worn(rng, mix(a, b, odd), rng.uniform(0.0, 0.3))


def stripes(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Bands of random widths, straight, slanted or wavy."""
    u, v = _grid(size)
    if rng.random() < 0.5:
        u, v = v, u
    bands = colors[rng.integers(0, len(colors), int(rng.integers(4, 20)))]
    edges = np.sort(rng.random(len(bands) - 1))
    wave = rng.choice([0.0, 0.0, 0.04]) * np.sin(2 * np.pi * int(rng.integers(1, 4)) * u)
    at = (v * int(rng.integers(1, 4)) + int(rng.integers(0, 2)) * u + wave) % 1.0
    return _worn(rng, bands[np.searchsorted(edges, at)], rng.uniform(0.0, 0.25))


def plaid(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Stripes both ways, woven."""
    across, along = stripes(rng, colors, size), stripes(rng, colors, size)
    u, v = _grid(size)
    over = (np.sin(2 * np.pi * 64 * u) * np.sin(2 * np.pi * 64 * v) > 0.0) * 0.3 + 0.35
    return mix(across, along.transpose(1, 0, 2), over)


def dots(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Dots or rings in rows, in several colors."""
    ground = _pick(rng, colors, 1)[0]
    count = int(rng.integers(3, 12))
    u, v = _grid(size)
    radius = np.hypot((u * count) % 1 - 0.5, (v * count) % 1 - 0.5)
    paint = colors[rng.integers(0, len(colors), (count, count))]
    own = paint[(v * count).astype(int), (u * count).astype(int)]
    outer = rng.uniform(0.2, 0.48)
    ring = (radius < outer) & (radius > outer * rng.choice([0.0, 0.0, 0.6]))
    picture = np.where(ring[..., None], own, ground)
    return _worn(rng, picture, rng.uniform(0.0, 0.25))


def wood(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Planks with grain along u, in a brown or a stain of the palette."""
    dark = hsv(rng.uniform(0.04, 0.1), rng.uniform(0.4, 0.75), rng.uniform(0.15, 0.5))
    light = np.clip(dark * rng.uniform(1.4, 2.2) + 0.08, 0.0, 1.0)
    if rng.random() < 0.2:
        dark, light = sorted(_pick(rng, colors, 2), key=lambda color: float(color.sum()))
    planks = int(rng.integers(1, 9))
    _, v = _grid(size)
    plank = (v * planks).astype(int)
    bent = octaves(rng, size, 2, 3)
    rings = np.sin(2 * np.pi * (v * rng.integers(4, 14) + 1.5 * bent + rng.random(planks)[plank]))
    streaks = octaves(rng, size, 4, 3, stretch=16)
    tone = rng.uniform(-0.25, 0.25, planks)[plank]
    picture = mix(dark, light, np.clip(0.25 * rings + 0.7 * streaks + 0.1 + tone, 0.0, 1.0))
    if planks > 1:
        across = (v * planks) % 1
        picture[np.minimum(across, 1 - across) < 0.025] *= 0.4
    return picture


def marble(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Veins through stone."""
    a, b = _pick(rng, colors, 2)
    a = 0.4 * a + 0.6 * rng.uniform(0.1, 0.95)
    u, v = _grid(size)
    warp = octaves(rng, size, 3, 6)
    vein = np.abs(np.sin(np.pi * (2 * int(rng.integers(1, 4)) * (u + v) + 2.5 * warp)))
    return mix(b, a, np.clip(vein ** rng.uniform(0.3, 0.8) + 0.2 * warp, 0.0, 1.0))


def stone(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Granite, concrete, gravel: a gray with grains of other tones."""
    base = 0.3 * _pick(rng, colors, 1)[0] + 0.7 * rng.uniform(0.25, 0.8)
    picture = np.broadcast_to(base, (size, size, 3)).copy()
    for _ in range(3):
        cells = int(rng.integers(24, size // 2))
        grains = noise(rng, size, size, (cells, cells)) > rng.uniform(0.6, 0.85)
        picture[grains] *= rng.uniform(0.4, 1.5)
    return _worn(rng, np.clip(picture, 0.0, 1.0), rng.uniform(0.2, 0.5))


def bricks(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """A wall in running bond, each brick with its own tone."""
    base = hsv(rng.uniform(0.0, 0.1), rng.uniform(0.3, 0.7), rng.uniform(0.35, 0.8))
    if rng.random() < 0.3:
        base = _pick(rng, colors, 1)[0]
    rows, columns = 2 * int(rng.integers(3, 9)), int(rng.integers(2, 7))
    u, v = _grid(size)
    row = (v * rows).astype(int)
    x = u * columns + 0.5 * (row % 2)
    tone = rng.uniform(0.65, 1.2, (rows, columns))[row, x.astype(int) % columns]
    picture = base * tone[..., None] * (0.75 + 0.35 * octaves(rng, size, 16, 3))[..., None]
    joint = (np.minimum(x % 1, 1 - x % 1) < 0.03) | (
        np.minimum((v * rows) % 1, 1 - (v * rows) % 1) < 0.07
    )
    picture[joint] = (
        rng.uniform(0.35, 0.8) * (0.8 + 0.2 * noise(rng, size, size, (64, 64)))[joint, None]
    )
    return np.clip(picture, 0.0, 1.0)


def tiles(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Square tiles with joints; plain, of several colors, or each with an ornament."""
    count = int(rng.integers(3, 9))
    u, v = _grid(size)
    x, y = (u * count) % 1 - 0.5, (v * count) % 1 - 0.5
    row, column = (v * count).astype(int), (u * count).astype(int)
    few = _pick(rng, colors, int(rng.integers(2, 5)))
    picture = few[rng.integers(0, len(few), (count, count))][row, column]
    if rng.random() < 0.5:
        petals, radius, angle = int(rng.integers(3, 9)), np.hypot(x, y), np.arctan2(y, x)
        ornament = radius < 0.28 + 0.14 * np.cos(petals * angle)
        picture[ornament] = _pick(rng, colors, 1)[0]
        picture[radius < 0.1] = few[0]
    picture *= rng.uniform(0.85, 1.0, (count, count))[row, column][..., None]
    picture[0.5 - np.maximum(np.abs(x), np.abs(y)) < 0.025] = rng.uniform(0.2, 0.9)
    return _worn(rng, picture, rng.uniform(0.0, 0.3))


def cells(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Crazy paving, scales or mosaic: the cells of random points, with joints (Worley 1996)."""
    count = int(rng.integers(12, 70))
    points = rng.random((count, 2))
    u, v = _grid(size)
    nearest = np.full((size, size), np.inf)
    second = nearest.copy()
    owner = np.zeros((size, size), dtype=int)
    for index, (x, y) in enumerate(points):
        away_u, away_v = np.abs(u - x), np.abs(v - y)
        distance = np.hypot(np.minimum(away_u, 1 - away_u), np.minimum(away_v, 1 - away_v))
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        owner[closer] = index
        nearest = np.where(closer, distance, nearest)
    few = _pick(rng, colors, 3)
    paint = few[rng.integers(0, len(few), count)] * rng.uniform(0.6, 1.1, (count, 1))
    picture = paint[owner] * (0.8 + 0.2 * octaves(rng, size, 8, 4))[..., None]
    picture[second - nearest < rng.uniform(0.004, 0.015)] *= 0.35
    return np.clip(picture, 0.0, 1.0)


def rust(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Paint that has come off in places."""
    paint = _pick(rng, colors, 1)[0]
    patches = octaves(rng, size, int(rng.integers(3, 7)), 6)
    brown = mix([0.25, 0.11, 0.05], [0.6, 0.31, 0.13], octaves(rng, size, 16, 4))
    bare = np.clip((patches - rng.uniform(0.5, 0.75)) * 20.0, 0.0, 1.0)
    return mix(_worn(rng, np.broadcast_to(paint, (size, size, 3)), 0.25), brown, bare)


def grass(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """Lawn, moss or dry ground: fine streaks in greens and browns."""
    hue = rng.uniform(0.1, 0.36)
    dark, light = hsv(hue, 0.7, 0.18), hsv(hue - 0.04, 0.55, 0.7)
    fine = noise(rng, size, size, (size // 2, size // 3))
    blades = 0.5 * fine + 0.5 * octaves(rng, size, 24, 3)
    picture = mix(dark, light, np.clip(1.8 * (blades - 0.5) + 0.45, 0.0, 1.0))
    bare = np.clip((octaves(rng, size, 4, 4) - 0.6) * 5.0, 0.0, 1.0)
    earth = 0.5 * _pick(rng, colors, 1)[0] + 0.5 * np.array([0.38, 0.28, 0.18])
    return mix(picture, earth * (0.6 + 0.5 * fine[..., None]), bare)


def printed(rng: np.random.Generator, colors: np.ndarray, size: int) -> np.ndarray:
    """A cover, a label or a page: words, rules and a roundel in the font that Pillow brings."""
    few = _pick(rng, colors, 3)
    image = Image.new("RGB", (size, size), _eight_bit(few[0]))
    draw = ImageDraw.Draw(image)
    if rng.random() < 0.5:
        left, top, wide, high = rng.uniform([0.0, 0.0, 0.2, 0.1], [0.6, 0.8, 1.0, 0.5]) * size
        draw.rectangle((left, top, left + wide, top + high), fill=_eight_bit(few[1]))
    if rng.random() < 0.5:
        x, y, radius = rng.uniform([0.2, 0.4, 0.08], [0.8, 0.8, 0.25]) * size
        for ring in range(4):
            reach = radius * (1 - ring / 4)
            draw.ellipse(
                (x - reach, y - reach, x + reach, y + reach), fill=_eight_bit(few[ring % 2 + 1])
            )
    line = rng.uniform(0.02, 0.1) * size
    title = rng.integers(0, 3)
    while line < 0.95 * size:
        letter = size * (rng.uniform(0.12, 0.2) if title > 0 else rng.uniform(0.04, 0.07))
        words = "".join(
            chr(code) if code < 91 else " "
            for code in rng.integers(65, 96, int(rng.integers(6, 30)))
        )
        ink = few[2] if title > 0 else np.where(few[0].mean() > 0.5, 0.08, 0.92) * np.ones(3)
        font = ImageFont.load_default(size=float(round(letter)))
        draw.text((0.05 * size, line), words, fill=_eight_bit(ink), font=font)
        line += 1.25 * letter
        title -= 1
    return _worn(rng, np.asarray(image) / 255.0, rng.uniform(0.0, 0.2))


def _eight_bit(color: np.ndarray) -> tuple[int, int, int]:
    red, green, blue = (round(255 * float(channel)) for channel in np.clip(color, 0, 1))
    return red, green, blue


def leaf_veins(rng: np.random.Generator, size: int) -> np.ndarray:
    """A leaf along u with its midrib at v = 1/2; greens, yellows and reds."""
    hue = rng.choice([rng.uniform(0.2, 0.4), rng.uniform(0.2, 0.4), rng.uniform(-0.03, 0.16)])
    dark, light = hsv(hue, rng.uniform(0.5, 0.9), rng.uniform(0.15, 0.5)), hsv(hue - 0.04, 0.5, 0.8)
    u, v = _grid(size)
    side = np.abs(v - 0.5)
    ribs = np.abs((u * 9 - 6 * side) % 1 - 0.5) < 0.06
    picture = mix(dark, light, 0.5 * octaves(rng, size, 4, 4))
    picture[ribs | (side < 0.02)] = 0.6 * light + 0.4 * dark
    return picture


def landscape(rng: np.random.Generator, size: int) -> np.ndarray:
    """A picture for a wall: hills under a sky; row 0 is at the bottom."""
    u, v = _grid(size)
    sky, low = hsv(rng.random(), rng.uniform(0.2, 0.6), 0.9), hsv(rng.random(), 0.3, 0.95)
    picture = mix(low, sky, v)
    sun = rng.uniform([0.2, 0.6], [0.8, 0.9])
    picture[np.hypot(u - sun[0], v - sun[1]) < 0.07] = [1.0, 0.93, 0.75]
    hue = rng.random()
    for step in range(4):
        ridge = 0.62 - 0.15 * step + 0.22 * (octaves(rng, size, 3, 5)[0] - 0.5)
        hill = hsv(hue + 0.05 * step, 0.5, 0.75 - 0.16 * step)
        picture[v < ridge[None, :]] = hill
    return picture * (0.8 + 0.2 * octaves(rng, size, 32, 3))[..., None]


#: Textures for any surface, each called with (rng, palette, size).
TEXTURES: dict[str, Callable[[np.random.Generator, np.ndarray, int], np.ndarray]] = {
    texture.__name__: texture
    for texture in (
        speckle, clouds, checker, stripes, plaid, dots, wood, marble, stone, bricks, tiles, cells,
        rust, grass, printed,
    )
}  # fmt: skip
