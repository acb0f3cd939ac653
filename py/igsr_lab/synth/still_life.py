"""Random piles, vessels, plants, fruit, books, drums and cloths.

Each function draws an object that stands on z = 0 about the z axis, of a size of about one unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from igsr_lab.synth.description import Part
from igsr_lab.synth.materials import Materials
from igsr_lab.synth.meshes import (
    Mesh,
    box,
    disc,
    joined,
    lathe,
    leaf,
    lumpy_ball,
    place,
    rotation,
    sheet,
    superquadric,
    transformed,
    tube,
)
from igsr_lab.synth.parts import (
    bounds,
    moved,
    random_solid,
    random_turn,
    repeated,
    rod,
)
from igsr_lab.synth.textures import leaf_veins


def pile(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Solids of all kinds next to and on top of each other."""
    parts: list[Part] = []
    tops: list[tuple[np.ndarray, float, float]] = []
    for _ in range(int(rng.integers(4, 11))):
        meshes, smooth = random_solid(rng)
        matrix = random_turn(rng) * rng.uniform(0.2, 0.5)
        meshes = [transformed(mesh, matrix) for mesh in meshes]
        low, high = bounds([Part(mesh, materials.plain()) for mesh in meshes])
        spot = rng.uniform(-0.75, 0.75, 2)
        wide = 0.5 * float((high - low)[:2].max())
        under = [top for at, reach, top in tops if np.linalg.norm(at - spot) < 0.7 * (reach + wide)]
        foot = max(under, default=0.0)
        tops.append((spot, wide, foot + 0.9 * float(high[2] - low[2])))
        material, times = materials.any(), float(rng.integers(1, 3))
        for mesh in meshes:
            raised = place(mesh, (spot[0], spot[1], foot - low[2]))
            parts.append(Part(repeated(raised, times), material, smooth))
    return parts


def vessel(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A vase, jug, bowl or bottle with handles, and sometimes a lid or flowers."""
    height = float(rng.uniform(0.5, 1.5))
    levels = np.linspace(0.04, height, int(rng.integers(4, 8)))
    radii = rng.uniform(0.18, 0.6, len(levels))
    radii = 0.6 * radii + 0.4 * radii.mean()
    outer = [(float(r), float(h)) for r, h in zip(radii, levels, strict=True)]
    inner = [(0.92 * r - 0.01, h) for r, h in reversed(outer)]
    body = materials.textured()
    parts = [Part(lathe([(0.0, 0.0), (float(radii[0]), 0.0), *outer, *inner, (0.0, 0.08)]), body)]
    trim = materials.any()
    middle = len(levels) // 2
    handles = int(rng.integers(0, 3))
    t = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 24)
    for index in range(handles):
        reach = 0.96 * min(radii[middle], radii[-1])
        path = np.stack(
            [
                reach + rng.uniform(0.2, 0.35) * np.cos(t),
                0 * t,
                0.62 * height + 0.27 * height * np.sin(t),
            ],
            -1,
        )
        mesh = tube(path, float(rng.uniform(0.025, 0.06)), closed=False, around=14)
        parts.append(Part(place(mesh, (0, 0, 0), math.pi * index), trim))
    top = float(radii[-1])
    if rng.random() < 0.5:
        lid = [(top, 0.0), (1.04 * top, 0.02), (0.7 * top, 0.09), (0.15 * top, 0.13)]
        lid += [(0.1 * top, 0.17), (0.22 * top, 0.22), (0.0, 0.26)]
        parts.append(Part(place(lathe(lid, 48), (0, 0, height)), trim))
    else:
        parts += _bouquet(rng, materials, (0.0, 0.0, 0.6 * height), 0.9, 0.5 * top)
    return parts


def _leaves(
    rng: np.random.Generator, feet: np.ndarray, length: float, slimness: float, droop: float
) -> Mesh:
    """One leaf at each foot [N, 3], turned at random."""
    meshes = []
    for foot in feet:
        blade = leaf(
            length * rng.uniform(0.6, 1.2), slimness * length, droop * float(rng.uniform(0.2, 1.4))
        )
        turn = rotation((0, 0, 1), float(rng.uniform(0, 2 * math.pi)))
        meshes.append(
            transformed(blade, turn @ rotation((0, 1, 0), -float(rng.uniform(0.0, 1.1))), foot)
        )
    return joined(meshes)


def _bouquet(
    rng: np.random.Generator,
    materials: Materials,
    foot: Sequence[float],
    height: float,
    spread: float,
) -> list[Part]:
    """Stems with leaves and, sometimes, flowers."""
    stems, feet, tips = [], [], []
    for _ in range(int(rng.integers(4, 14))):
        start = np.asarray(foot) + [*rng.normal(0, 0.3 * spread, 2), 0.0]
        end = start + [*rng.normal(0, 0.45 * height, 2), height * rng.uniform(0.5, 1.1)]
        share = np.linspace(0, 1, 9)[:, None]
        path = start + share**1.6 * (end - start) * [1, 1, 0] + share * (end - start) * [0, 0, 1]
        stems.append(tube(path, 0.012, closed=False, around=6))
        feet.extend(path[rng.integers(2, 9, int(rng.integers(2, 8)))])
        tips.append(end)
    green = materials.coated(leaf_veins(rng, 128))
    parts = [Part(joined(stems), green)]
    slim = float(rng.uniform(0.15, 0.6))
    parts.append(
        Part(
            _leaves(rng, np.array(feet), float(rng.uniform(0.2, 0.45)), slim, rng.uniform(0, 2)),
            green,
        )
    )
    if rng.random() < 0.6:
        petal = materials.coated(materials.color())
        blooms = [_leaves(rng, np.repeat(tip[None], 7, 0), 0.14, 0.6, 0.6) for tip in tips]
        hearts = [place(superquadric((1, 1), [0.035] * 3, 12), tip) for tip in tips]
        parts += [Part(joined(blooms), petal), Part(joined(hearts), materials.plain())]
    return parts


def plant(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A pot with dense foliage."""
    wall = [(0.0, 0.0), (0.22, 0.0), (0.24, 0.02), (0.34, 0.4), (0.37, 0.4), (0.37, 0.46)]
    wall += [(0.32, 0.46), (0.3, 0.38), (0.0, 0.38)]
    parts = [Part(lathe(wall, 64), materials.textured())]
    for _ in range(int(rng.integers(1, 4))):
        parts += _bouquet(rng, materials, (0, 0, 0.38), float(rng.uniform(0.5, 1.1)), 0.3)
    return parts


def tree(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A forked trunk with leaves on its twigs."""
    limbs, feet = [], []
    ends = [(np.zeros(3), np.array([0.0, 0.0, rng.uniform(0.35, 0.7)]), 0.07)]
    for level in range(4):
        following = []
        for start, way, thickness in ends:
            end = start + way
            middle = start + 0.5 * way + rng.normal(0, 0.06, 3) * np.linalg.norm(way)
            limbs.append(tube(np.array([start, middle, end]), thickness, False, 8))
            if level >= 2:
                feet.extend(end - way * rng.uniform(0, 0.6, (5, 1)))
            for _ in range(int(rng.integers(2, 4))):
                bent = way / np.linalg.norm(way) + rng.normal(0, 0.6, 3) + [0, 0, 0.15]
                length = np.linalg.norm(way) * rng.uniform(0.6, 0.85)
                following.append((end, bent / np.linalg.norm(bent) * length, 0.62 * thickness))
        ends = following[:14]
    bark = materials.coated(materials.texture("wood", "stone", "rust"))
    parts = [Part(joined(limbs), bark)]
    if rng.random() < 0.85:
        green = materials.coated(leaf_veins(rng, 128))
        size, slim = float(rng.uniform(0.1, 0.2)), float(rng.uniform(0.3, 0.7))
        parts.append(Part(_leaves(rng, np.array(feet), size, slim, 1.0), green))
    return parts


def books(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Stacks of books, cartons and boxes with print on them."""
    parts: list[Part] = []
    paper = np.broadcast_to(
        rng.uniform(0.7, 1.0, (64, 1, 1)) * [0.96, 0.92, 0.82], (64, 16, 3)
    ).copy()
    for _ in range(int(rng.integers(1, 4))):
        spot, height = rng.uniform(-0.7, 0.7, 2), 0.0
        for _ in range(int(rng.integers(1, 6))):
            size = rng.uniform([0.45, 0.35, 0.06], [0.8, 0.6, 0.3])
            cover, turn = (
                materials.textured("printed", "printed", "plaid", "stripes"),
                rng.uniform(-0.6, 0.6),
            )
            for index, side in enumerate(box((size[0], size[1], size[2]))):
                pages = index in (0, 2, 3) and size[2] < 0.2
                at = (spot[0], spot[1], height)
                material = materials.coated(paper) if pages else cover
                parts.append(Part(place(side, at, turn), material, False))
            height += float(size[2])
    return parts


def fruit(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A bowl of lumpy round fruit."""
    bowl = [
        (0.0, 0.0),
        (0.25, 0.0),
        (0.5, 0.1),
        (0.72, 0.3),
        (0.7, 0.31),
        (0.48, 0.14),
        (0.0, 0.05),
    ]
    parts = [Part(lathe(bowl), materials.textured())]
    skins = [materials.textured("speckle", "clouds", "marble", "stripes") for _ in range(4)]
    for _ in range(int(rng.integers(6, 16))):
        size = rng.uniform(0.1, 0.22)
        ball = lumpy_ball(rng, float(rng.uniform(0.03, 0.3)), float(rng.uniform(0.3, 1.2)), 32)
        spot = rng.normal(0, 0.22, 2)
        at = (spot[0], spot[1], 0.2 + 0.4 * float(rng.random()) * (1 - min(np.hypot(*spot), 1.0)))
        stretched = random_turn(rng) @ np.diag([1, 1, rng.uniform(0.7, 1.6)])
        parts.append(Part(transformed(ball, size * stretched, at), skins[rng.integers(4)]))
    return parts


def drums(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Drums on thin stands with metal discs."""
    parts: list[Part] = []
    for _ in range(int(rng.integers(3, 6))):
        at, radius = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.18, 0.35)
        deep, foot = rng.uniform(0.15, 0.45), rng.uniform(0.15, 0.6)
        shell = [(radius, 0.0), (radius, 0.01), (radius, deep - 0.01), (radius, deep)]
        tilt = rotation((1, 0.3, 0), float(rng.uniform(-0.35, 0.35)))
        center = (at[0], at[1], foot)
        parts.append(Part(transformed(lathe(shell, 48), tilt, center), materials.textured()))
        skin = Part(place(disc(radius), (0, 0, deep)), materials.textured("speckle", "printed"))
        parts += moved([skin], tilt, center)
        legs = [
            rod(center, (at[0] + 0.3 * math.cos(a), at[1] + 0.3 * math.sin(a), 0.0), 0.014)
            for a in (0.3, 2.4, 4.5)
        ]
        parts.append(Part(joined(legs), materials.metal()))
    for _ in range(int(rng.integers(1, 4))):
        at, height = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.7, 1.2)
        dish = lathe([(0.0, 0.05), (0.05, 0.04), (0.3, 0.0), (0.3, -0.005), (0.0, 0.035)], 64)
        tilt = rotation((0.2, 1, 0), float(rng.uniform(-0.4, 0.4)))
        parts.append(Part(transformed(dish, tilt, (at[0], at[1], height)), materials.metal()))
        parts.append(
            Part(rod((at[0], at[1], 0.0), (at[0], at[1], height), 0.012), materials.metal())
        )
    return parts


def cloth(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A draped cloth with a few solids on it."""
    x, y = np.meshgrid(np.linspace(-1, 1, 65), np.linspace(-1, 1, 65))
    folds = np.zeros_like(x)
    for _ in range(5):
        way = rng.normal(size=2) * 3.0
        folds += rng.uniform(0.01, 0.05) * np.sin(way[0] * x + way[1] * y + rng.uniform(0, 6))
    hump = rng.uniform(0.0, 0.5) * np.exp(-((x - 0.2) ** 2 + (y + 0.1) ** 2) * 6)
    drape = folds - folds.min() + hump
    parts = [
        Part(
            sheet(1.8, 1.8, drape),
            materials.textured("plaid", "stripes", "dots", "checker", "clouds"),
        )
    ]
    for _ in range(int(rng.integers(2, 5))):
        meshes, smooth = random_solid(rng)
        turn, size, spot = random_turn(rng), rng.uniform(0.15, 0.3), rng.uniform(-0.6, 0.6, 2)
        material = materials.any()
        height = drape[int(32 * (spot[1] / 0.9 + 1)), int(32 * (spot[0] / 0.9 + 1))]
        at = (spot[0], spot[1], height + 0.6 * size)
        parts += [Part(transformed(mesh, size * turn, at), material, smooth) for mesh in meshes]
    return parts
