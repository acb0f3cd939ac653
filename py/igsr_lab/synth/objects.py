"""Objects composed at random: piles, vessels, furniture, plants, machines, figures.

Each function of ``OBJECTS`` draws one object that stands on z = 0 about the z axis, of a size of
about one unit, as a list of parts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from igsr_lab.synth.description import Part
from igsr_lab.synth.materials import Materials
from igsr_lab.synth.meshes import (
    Mesh,
    box,
    disc,
    gear,
    joined,
    lathe,
    leaf,
    lumpy_ball,
    place,
    prism,
    rotation,
    sheet,
    star,
    superquadric,
    transformed,
    tube,
)
from igsr_lab.synth.textures import leaf_veins


def moved(
    parts: Sequence[Part], matrix: np.ndarray, at: Sequence[float] | np.ndarray
) -> list[Part]:
    """The parts under x -> matrix x + at."""
    return [Part(transformed(part.mesh, matrix, at), part.material, part.smooth) for part in parts]


def bounds(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest corner of what the parts cover."""
    lowest = np.min([part.mesh[0].min(axis=0) for part in parts], axis=0)
    highest = np.max([part.mesh[0].max(axis=0) for part in parts], axis=0)
    return lowest, highest


def random_object(rng: np.random.Generator) -> tuple[str, list[Part]]:
    """The name and parts of an object, standing on z = 0 and reaching 1 from the z axis or up."""
    name = str(rng.choice(tuple(OBJECTS)))
    parts = OBJECTS[name](rng, Materials(rng))
    lowest, highest = bounds(parts)
    middle = 0.5 * (lowest + highest)
    reach = max(0.5 * float(np.hypot(*(highest - lowest)[:2])), 0.6 * float((highest - lowest)[2]))
    at = -np.array([middle[0], middle[1], lowest[2]]) / reach
    return name, moved(parts, np.eye(3) / reach, at)


def _repeated(mesh: Mesh, times: float) -> Mesh:
    """The mesh with its texture repeated so many times."""
    return mesh[0], mesh[1], mesh[2] * times


def _box(
    size: Sequence[float] | np.ndarray,
    at: Sequence[float] | np.ndarray,
    turn: float = 0.0,
    times: float = 1.0,
) -> Mesh:
    sides = joined(box((float(size[0]), float(size[1]), float(size[2]))))
    return _repeated(place(sides, at, turn), times)


def _rod(
    start: Sequence[float] | np.ndarray, end: Sequence[float] | np.ndarray, radius: float
) -> Mesh:
    path = np.linspace(np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64), 3)
    return tube(path, radius, closed=False, around=12)


def _turn(rng: np.random.Generator) -> np.ndarray:
    return rotation(rng.normal(size=3), float(rng.uniform(0, 2 * math.pi)))


def _knot(rng: np.random.Generator) -> Mesh:
    """A torus knot, a spring or a ring."""
    t = np.linspace(0, 2 * np.pi, 161)
    kind = rng.integers(3)
    if kind == 0:
        p, q = ((2, 3), (3, 2), (2, 5))[rng.integers(3)]
        ring = 0.62 + 0.26 * np.cos(q * t)
        path = np.stack([ring * np.cos(p * t), ring * np.sin(p * t), 0.3 * np.sin(q * t)], -1)
        return tube(path, float(rng.uniform(0.05, 0.13)), closed=True, around=14)
    if kind == 1:
        coils = rng.integers(3, 8)
        path = np.stack([0.5 * np.cos(coils * t), 0.5 * np.sin(coils * t), t / 3.2 - 1.0], -1)
        return tube(path, float(rng.uniform(0.03, 0.08)), closed=False, around=12)
    path = np.stack([0.75 * np.cos(t), 0.75 * np.sin(t), 0.0 * t], -1)
    return tube(path, float(rng.uniform(0.05, 0.25)), closed=True, around=20)


def _solid(rng: np.random.Generator) -> tuple[list[Mesh], bool]:
    """A random solid of a size of about 1 and whether it is smooth."""
    kind = rng.integers(7)
    if kind == 0:
        roundness = rng.uniform(0.15, 1.8, 2)
        size = rng.uniform(0.35, 1.0, 3)
        return [superquadric((roundness[0], roundness[1]), size)], True
    if kind == 1:
        return [lumpy_ball(rng, rng.uniform(0.1, 0.5), rng.uniform(0.5, 4.0))], True
    if kind == 2:
        return [_box(rng.uniform(0.4, 1.5, 3), (0, 0, -0.5))], False
    if kind == 3:
        outline = 0.8 * star(int(rng.integers(3, 9)), float(rng.uniform(0.45, 1.0)), 3)
        walls = prism(outline, 1.2, float(rng.uniform(-1, 1)), float(rng.uniform(0.3, 1.1)))
        return [place(mesh, (0, 0, -0.6)) for mesh in walls], False
    if kind == 4:
        heights = np.linspace(-0.8, 0.8, int(rng.integers(4, 9)))
        profile = [(0.0, -0.8), *((float(rng.uniform(0.12, 0.7)), float(h)) for h in heights)]
        return [lathe([*profile, (0.0, 0.8)], 48)], True
    if kind == 5:
        return [_knot(rng)], True
    outline = 0.8 * gear(int(rng.integers(8, 20)), float(rng.uniform(0.1, 0.25)))
    return [place(mesh, (0, 0, -0.15)) for mesh in prism(outline, 0.3, levels=1)], False


def pile(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Solids of all kinds beside and upon each other."""
    parts: list[Part] = []
    tops: list[tuple[np.ndarray, float, float]] = []
    for _ in range(int(rng.integers(4, 11))):
        meshes, smooth = _solid(rng)
        matrix = _turn(rng) * rng.uniform(0.2, 0.5)
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
            parts.append(Part(_repeated(raised, times), material, smooth))
    return parts


def vessel(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A vase, jug, bowl or bottle with handles, and at times a lid or flowers."""
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
    """One leaf at each foot [N, 3], turned about at random."""
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
    """Stems with leaves and, at times, flowers."""
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
        petal = materials.coated(materials.colour())
        blooms = [_leaves(rng, np.repeat(tip[None], 7, 0), 0.14, 0.6, 0.6) for tip in tips]
        hearts = [place(superquadric((1, 1), [0.035] * 3, 12), tip) for tip in tips]
        parts += [Part(joined(blooms), petal), Part(joined(hearts), materials.plain())]
    return parts


def plant(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A pot with much foliage."""
    wall = [(0.0, 0.0), (0.22, 0.0), (0.24, 0.02), (0.34, 0.4), (0.37, 0.4), (0.37, 0.46)]
    wall += [(0.32, 0.46), (0.3, 0.38), (0.0, 0.38)]
    parts = [Part(lathe(wall, 64), materials.textured())]
    for _ in range(int(rng.integers(1, 4))):
        parts += _bouquet(rng, materials, (0, 0, 0.38), float(rng.uniform(0.5, 1.1)), 0.3)
    return parts


def tree(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A trunk that forks, with leaves at the ends of its twigs."""
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


def chair(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A chair, stool or small table with a slatted or cushioned back."""
    wide, deep = rng.uniform(0.7, 1.1, 2)
    seat, thick = rng.uniform(0.45, 0.9), rng.uniform(0.03, 0.09)
    frame = (
        materials.textured("wood", "speckle", "rust") if rng.random() < 0.7 else materials.metal()
    )
    legs = []
    splay = rng.uniform(0.0, 0.15)
    thin = rng.uniform(0.02, 0.05)
    corners = [(x * 0.44 * wide, y * 0.44 * deep) for x in (-1, 1) for y in (-1, 1)]
    for x, y in corners:
        legs.append(_rod((x * (1 + splay), y * (1 + splay), 0), (x, y, seat), thin))
    if rng.random() < 0.6:
        height = rng.uniform(0.15, 0.4) * seat
        for a, b in ((0, 1), (2, 3), (0, 2)):
            legs.append(_rod((*corners[a], height), (*corners[b], height), 0.6 * thin))
    parts = [Part(joined(legs), frame)]
    parts.append(
        Part(_box((wide, deep, thick), (0, 0, seat), times=1.0), materials.textured(), False)
    )
    if rng.random() < 0.75:
        back = seat + rng.uniform(0.5, 0.9)
        posts = [
            _rod((x, 0.44 * deep, seat), (x, 0.52 * deep, back), thin) for x, _ in corners[::2]
        ]
        slats = int(rng.integers(2, 9))
        if rng.random() < 0.5:
            for x in np.linspace(-0.4, 0.4, slats) * wide:
                posts.append(_rod((x, 0.46 * deep, seat), (x, 0.52 * deep, back), 0.5 * thin))
        else:
            for z in np.linspace(seat + 0.15, back, slats):
                posts.append(_box((0.88 * wide, 0.03, 0.06), (0, 0.48 * deep, z - 0.03)))
        posts.append(
            _rod((-0.44 * wide, 0.52 * deep, back), (0.44 * wide, 0.52 * deep, back), thin)
        )
        parts.append(Part(joined(posts), frame, False))
    if rng.random() < 0.5:
        cushion = superquadric((0.4, 0.3), (0.42 * wide, 0.42 * deep, 0.07))
        parts.append(
            Part(place(_repeated(cushion, 2.0), (0, 0, seat + thick + 0.06)), materials.textured())
        )
    return parts


def bricks(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Studded toy bricks of many colours, stacked on a plate."""
    unit, height = 0.16, 0.19
    cells = int(rng.integers(6, 11))
    parts: list[Part] = []
    level = np.zeros((cells, cells), dtype=int)
    stud = lathe([(0.048, 0.0), (0.048, 0.034), (0.045, 0.036), (0.0, 0.036)], 14)
    paints = [
        materials.coated(colour if rng.random() < 0.8 else materials.texture("printed"))
        for colour in materials.colours
    ]

    def lay(x: int, y: int, wide: int, deep: int, floor: int, high: float, paint: int) -> None:
        size = (wide * unit - 0.004, deep * unit - 0.004, high - 0.003)
        at = ((x + 0.5 * wide) * unit, (y + 0.5 * deep) * unit, floor * height)
        studs = [
            place(stud, ((x + i + 0.5) * unit, (y + j + 0.5) * unit, floor * height + high))
            for i in range(wide)
            for j in range(deep)
            if level[x + i, y + j] == floor + 1 or high < height
        ]
        parts.append(Part(_box(size, at), paints[paint], False))
        if studs:
            parts.append(Part(joined(studs), paints[paint]))

    laid = []
    for _ in range(int(rng.integers(20, 60))):
        wide, deep = ((1, 2), (2, 2), (2, 4), (4, 2), (2, 1), (1, 4), (3, 2))[rng.integers(7)]
        x, y = rng.integers(0, cells - wide + 1), rng.integers(0, cells - deep + 1)
        under = level[x : x + wide, y : y + deep]
        floor = int(under.max())
        if floor < 7:
            level[x : x + wide, y : y + deep] = floor + 1
            laid.append((int(x), int(y), wide, deep, floor, height, int(rng.integers(len(paints)))))
    for item in laid:
        lay(*item)
    plate = _box(
        (cells * unit, cells * unit, 0.05), (0.5 * cells * unit, 0.5 * cells * unit, -0.05)
    )
    parts.append(Part(plate, materials.plain(), False))
    return parts


def cage(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Wires about something: a bird cage, a crate of rods or a ball of rings."""
    thin = float(rng.uniform(0.008, 0.025))
    wires: list[Mesh] = []
    count = int(rng.integers(8, 22))
    t = np.linspace(0, 2 * np.pi, 49)
    kind = rng.integers(3)
    if kind == 0:
        height = float(rng.uniform(0.6, 1.1))
        arc = np.linspace(0, 0.5 * np.pi, 9)
        for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
            out = np.array([math.cos(angle), math.sin(angle), 0])
            dome = [0.5 * math.cos(a) * out + [0, 0, height + 0.5 * math.sin(a)] for a in arc]
            wires.append(tube(np.array([0.5 * out, *dome]), thin, False, 8))
        for z in np.linspace(0.02, height, int(rng.integers(2, 6))):
            ring = np.stack([0.5 * np.cos(t), 0.5 * np.sin(t), 0 * t + z], -1)
            wires.append(tube(ring, 1.3 * thin, True, 8))
    elif kind == 1:
        per_side = int(rng.integers(3, 8))
        steps = np.linspace(-0.5, 0.5, per_side)
        for a in steps:
            for side in (-0.5, 0.5):
                wires.append(_rod((a, side, 0), (a, side, 1), thin))
                wires.append(_rod((side, a, 0), (side, a, 1), thin))
                wires.append(_rod((-0.5, side, a + 0.5), (0.5, side, a + 0.5), thin))
                wires.append(_rod((side, -0.5, a + 0.5), (side, 0.5, a + 0.5), thin))
    else:
        ring = np.stack([0.55 * np.cos(t), 0.55 * np.sin(t), 0 * t], -1)
        for _ in range(count):
            wires.append(tube(ring @ _turn(rng).T + [0, 0, 0.55], thin, True, 8))
    parts = [Part(joined(wires), materials.metal() if rng.random() < 0.5 else materials.plain())]
    meshes, smooth = _solid(rng)
    inside = materials.textured()
    parts += [
        Part(transformed(mesh, 0.3 * _turn(rng), (0, 0, 0.42)), inside, smooth) for mesh in meshes
    ]
    base = lathe([(0.0, -0.06), (0.72, -0.06), (0.72, 0.0), (0.0, 0.0)])
    parts.append(Part(base, materials.textured()))
    return parts


def machine(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Boxes, gears on shafts, pipes and gauges on a base."""
    parts = [Part(_box((1.5, 1.0, 0.12), (0, 0, 0)), materials.textured("rust", "speckle"), False)]
    for _ in range(int(rng.integers(2, 5))):
        size = rng.uniform(0.2, 0.6, 3)
        spot = rng.uniform([-0.5, -0.3], [0.5, 0.3])
        parts.append(Part(_box(size, (*spot, 0.12)), materials.textured(), False))
    for _ in range(int(rng.integers(2, 6))):
        radius = rng.uniform(0.12, 0.35)
        outline = radius * gear(int(rng.integers(8, 22)), float(rng.uniform(0.12, 0.25)))
        wheel = joined(prism(outline, float(rng.uniform(0.05, 0.12)), levels=1))
        side = rng.choice([-1.0, 1.0])
        at = np.array([rng.uniform(-0.6, 0.6), side * rng.uniform(0.3, 0.5), rng.uniform(0.4, 0.8)])
        metal = materials.metal() if rng.random() < 0.5 else materials.textured("rust")
        parts.append(Part(transformed(wheel, rotation((1, 0, 0), math.pi / 2), at), metal, False))
        parts.append(Part(_rod(at - [0, 0.45, 0], at + [0, 0.45, 0], 0.03), metal))
    for _ in range(int(rng.integers(2, 7))):
        ends = rng.uniform([-0.7, -0.45, 0.1], [0.7, 0.45, 0.9], (4, 3))
        share = np.linspace(0, 1, 24)[:, None]
        curve = (1 - share) ** 3 * ends[0] + 3 * share * (1 - share) ** 2 * ends[1]
        curve = curve + 3 * share**2 * (1 - share) * ends[2] + share**3 * ends[3]
        pipe = tube(curve, float(rng.uniform(0.012, 0.06)), False, 12)
        parts.append(Part(pipe, materials.metal() if rng.random() < 0.4 else materials.plain()))
    return parts


def figure(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A robot, doll or animal: a body with head, eyes, limbs and a hat."""
    parts: list[Part] = []
    skin, cloth, trim = materials.any(), materials.textured(), materials.any()
    leg = rng.uniform(0.2, 0.6)
    body = rng.uniform([0.18, 0.14, 0.25], [0.4, 0.35, 0.45])
    roundness = rng.uniform(0.2, 1.0, 2)
    middle = leg + body[2]
    parts.append(
        Part(place(superquadric((roundness[0], roundness[1]), body), (0, 0, middle)), cloth)
    )
    head = rng.uniform(0.16, 0.3)
    neck = middle + body[2] + 0.8 * head
    roundness = rng.uniform(0.3, 1.0, 2)
    skull = superquadric((roundness[0], roundness[1]), head * rng.uniform(0.8, 1.1, 3))
    parts.append(Part(place(skull, (0, 0, neck)), skin))
    eye = superquadric((1, 1), [0.22 * head] * 3, 16)
    for x in (-0.4, 0.4):
        at = np.array([x * head, -0.82 * head, neck + 0.2 * head])
        parts.append(Part(place(eye, at), materials.coated(np.array([0.92, 0.92, 0.9]))))
        pupil = transformed(eye, 0.55 * np.eye(3), at - [0, 0.14 * head, 0])
        parts.append(Part(pupil, materials.coated(np.array([0.03, 0.03, 0.04]))))
    legs = (-0.55, 0.55) if rng.random() < 0.6 else (-0.7, -0.3, 0.3, 0.7)
    for x in legs:
        foot = np.array([x * body[0] * 1.2, rng.uniform(-0.2, 0.2), 0.04])
        parts.append(Part(_rod((x * body[0], 0, leg + 0.3 * body[2]), foot, 0.055), trim))
        parts.append(Part(place(superquadric((0.6, 1), (0.08, 0.13, 0.05), 20), foot), skin))
    for side in (-1, 1):
        shoulder = np.array([side * 0.95 * body[0], 0, middle + 0.6 * body[2]])
        elbow = shoulder + [side * rng.uniform(0.05, 0.25), rng.uniform(-0.25, 0.1), -0.2]
        hand = elbow + [
            side * rng.uniform(-0.1, 0.2),
            rng.uniform(-0.3, 0.0),
            rng.uniform(-0.2, 0.3),
        ]
        parts.append(Part(tube(np.array([shoulder, elbow, hand]), 0.045, False, 12), trim))
        parts.append(Part(place(superquadric((1, 1), [0.075] * 3, 20), hand), skin))
    if rng.random() < 0.7:
        brim = [(0.0, 0.0), (1.3 * head, 0.0), (1.3 * head, 0.02), (0.75 * head, 0.04)]
        brim += [(float(rng.uniform(0.2, 0.8)) * head, float(rng.uniform(0.1, 0.4))), (0.0, 0.3)]
        parts.append(Part(place(lathe(brim, 48), (0, 0, neck + 0.65 * head)), materials.textured()))
    return parts


def vehicle(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A car, cart or digger: hull, cabin, wheels, rails, an arm or masts."""
    length, width = rng.uniform(1.2, 1.8), rng.uniform(0.5, 0.8)
    wheel = rng.uniform(0.14, 0.26)
    hull, trim = materials.textured(), materials.any()
    base = 1.2 * wheel
    parts = [Part(_box((length, width, 0.28), (0, 0, base), times=1.0), hull, False)]
    cabin_at = rng.uniform(-0.25, 0.25) * length
    cabin = _box((rng.uniform(0.3, 0.6) * length, 0.9 * width, 0.34), (cabin_at, 0, base + 0.28))
    parts.append(Part(cabin, materials.textured("printed", "stripes", "speckle", "tiles"), False))
    nose = superquadric((0.5, 0.5), (0.25, 0.5 * width, 0.17))
    parts.append(Part(place(nose, (0.5 * length, 0, base + 0.14)), hull))
    profile = [(0.0, -0.06), (0.5 * wheel, -0.06), (0.6 * wheel, -0.09), (wheel, -0.08)]
    profile += [(wheel, 0.08), (0.6 * wheel, 0.09), (0.5 * wheel, 0.06), (0.0, 0.06)]
    tyre = transformed(lathe(profile, 40), rotation((1, 0, 0), math.pi / 2))
    rubber = materials.coated(materials.texture("checker", "speckle", "stripes") * 0.4)
    axles = np.linspace(-0.38, 0.38, int(rng.integers(2, 5))) * length
    for x in axles:
        for side in (-1, 1):
            parts.append(Part(place(tyre, (x, side * (0.5 * width + 0.05), wheel)), rubber))
        parts.append(Part(_rod((x, -0.6 * width, wheel), (x, 0.6 * width, wheel), 0.05), trim))
    rails = []
    top = base + 0.28
    for x in np.linspace(-0.48, 0.48, int(rng.integers(4, 10))) * length:
        for y in (-0.48 * width, 0.48 * width):
            rails.append(_rod((x, y, top), (x, y, top + 0.18), 0.012))
    for y in (-0.48 * width, 0.48 * width):
        start, end = (-0.48 * length, y, top + 0.18), (0.48 * length, y, top + 0.18)
        rails.append(_rod(start, end, 0.014))
    parts.append(Part(joined(rails), materials.metal() if rng.random() < 0.5 else trim))
    if rng.random() < 0.6:
        joints = np.array([[-0.3 * length, 0, top], [0.0, 0, 0], [0.0, 0, 0], [0.0, 0, 0]])
        for index in range(1, 4):
            joints[index] = joints[index - 1] + rng.uniform([0.1, -0.1, -0.1], [0.45, 0.1, 0.5])
        for a, b in itertools.pairwise(joints):
            parts.append(Part(_rod(a, b, 0.045), trim))
            parts.append(Part(place(superquadric((1, 1), [0.07] * 3, 16), b), hull))
        bucket = superquadric((0.3, 0.3), (0.16, 0.22, 0.1))
        parts.append(Part(place(bucket, joints[-1]), materials.textured("rust", "stripes")))
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


def tower(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A house or tower with windows, columns, a roof and a fence."""
    parts: list[Part] = []
    height, wide = 0.0, rng.uniform(0.6, 1.0)
    stories = materials.textured("bricks", "stone", "tiles", "speckle")
    dark = materials.coated(0.25 * materials.colour())
    for _ in range(int(rng.integers(1, 4))):
        floor, deep = rng.uniform(0.3, 0.6), wide * rng.uniform(0.7, 1.0)
        parts.append(Part(_box((wide, deep, floor), (0, 0, height), times=2.0), stories, False))
        panes = []
        for x in np.linspace(-0.36, 0.36, int(rng.integers(2, 6))) * wide:
            for side in (-0.5, 0.5):
                panes.append(
                    _box((0.09, 0.03, 0.45 * floor), (x, side * deep, height + 0.3 * floor))
                )
                panes.append(
                    _box(
                        (0.03, 0.09, 0.45 * floor),
                        (side * wide, x * deep / wide, height + 0.3 * floor),
                    )
                )
        parts.append(Part(joined(panes), dark, False))
        ledge = _box((1.06 * wide, 1.06 * deep, 0.04), (0, 0, height + floor))
        parts.append(Part(ledge, materials.plain(), False))
        height += floor + 0.04
        wide *= rng.uniform(0.6, 0.95)
    outline = 0.75 * wide * star(int(rng.integers(2, 9)), 1.0, 4)
    roof = prism(outline, float(rng.uniform(0.2, 0.7)), 0.0, 0.05)
    parts += [
        Part(place(mesh, (0, 0, height)), materials.textured("tiles", "bricks", "wood"), False)
        for mesh in roof[:1]
    ]
    posts = []
    count = int(rng.integers(16, 36))
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        x, y = 0.85 * math.cos(angle), 0.85 * math.sin(angle)
        posts.append(_rod((x, y, 0), (x, y, 0.2), 0.015))
    t = np.linspace(0, 2 * np.pi, 49)
    for z in (0.08, 0.17):
        posts.append(
            tube(np.stack([0.85 * np.cos(t), 0.85 * np.sin(t), 0 * t + z], -1), 0.012, True, 8)
        )
    parts.append(Part(joined(posts), materials.plain()))
    lawn = materials.coated(materials.texture("grass", "stone", "tiles"))
    parts.append(Part(disc(1.0), lawn))
    return parts


def fruit(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A bowl or plate of lumpy round things."""
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
        stretched = _turn(rng) @ np.diag([1, 1, rng.uniform(0.7, 1.6)])
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
            _rod(center, (at[0] + 0.3 * math.cos(a), at[1] + 0.3 * math.sin(a), 0.0), 0.014)
            for a in (0.3, 2.4, 4.5)
        ]
        parts.append(Part(joined(legs), materials.metal()))
    for _ in range(int(rng.integers(1, 4))):
        at, height = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.7, 1.2)
        dish = lathe([(0.0, 0.05), (0.05, 0.04), (0.3, 0.0), (0.3, -0.005), (0.0, 0.035)], 64)
        tilt = rotation((0.2, 1, 0), float(rng.uniform(-0.4, 0.4)))
        parts.append(Part(transformed(dish, tilt, (at[0], at[1], height)), materials.metal()))
        parts.append(
            Part(_rod((at[0], at[1], 0.0), (at[0], at[1], height), 0.012), materials.metal())
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
        meshes, smooth = _solid(rng)
        turn, size, spot = _turn(rng), rng.uniform(0.15, 0.3), rng.uniform(-0.6, 0.6, 2)
        material = materials.any()
        height = drape[int(32 * (spot[1] / 0.9 + 1)), int(32 * (spot[0] / 0.9 + 1))]
        at = (spot[0], spot[1], height + 0.6 * size)
        parts += [Part(transformed(mesh, size * turn, at), material, smooth) for mesh in meshes]
    return parts


#: What ``random_object`` draws from.
OBJECTS: dict[str, Callable[[np.random.Generator, Materials], list[Part]]] = {
    kind.__name__: kind
    for kind in (
        pile, vessel, plant, tree, chair, bricks, cage, machine, figure, vehicle, books, tower,
        fruit, drums, cloth,
    )
}  # fmt: skip
