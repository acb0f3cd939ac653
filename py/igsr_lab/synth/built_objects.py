"""Random furniture, toys, cages, machines, figures, vehicles and towers.

Each function draws an object that stands on z = 0 about the z axis, of a size of about one unit.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from igsr_lab.synth.description import Part
from igsr_lab.synth.materials import Materials
from igsr_lab.synth.meshes import (
    Mesh,
    disc,
    gear,
    joined,
    lathe,
    place,
    prism,
    rotation,
    star,
    superquadric,
    transformed,
    tube,
)
from igsr_lab.synth.parts import block, random_solid, random_turn, repeated, rod


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
        legs.append(rod((x * (1 + splay), y * (1 + splay), 0), (x, y, seat), thin))
    if rng.random() < 0.6:
        height = rng.uniform(0.15, 0.4) * seat
        for a, b in ((0, 1), (2, 3), (0, 2)):
            legs.append(rod((*corners[a], height), (*corners[b], height), 0.6 * thin))
    parts = [Part(joined(legs), frame)]
    parts.append(
        Part(block((wide, deep, thick), (0, 0, seat), times=1.0), materials.textured(), False)
    )
    if rng.random() < 0.75:
        back = seat + rng.uniform(0.5, 0.9)
        posts = [rod((x, 0.44 * deep, seat), (x, 0.52 * deep, back), thin) for x, _ in corners[::2]]
        slats = int(rng.integers(2, 9))
        if rng.random() < 0.5:
            for x in np.linspace(-0.4, 0.4, slats) * wide:
                posts.append(rod((x, 0.46 * deep, seat), (x, 0.52 * deep, back), 0.5 * thin))
        else:
            for z in np.linspace(seat + 0.15, back, slats):
                posts.append(block((0.88 * wide, 0.03, 0.06), (0, 0.48 * deep, z - 0.03)))
        posts.append(rod((-0.44 * wide, 0.52 * deep, back), (0.44 * wide, 0.52 * deep, back), thin))
        parts.append(Part(joined(posts), frame, False))
    if rng.random() < 0.5:
        cushion = superquadric((0.4, 0.3), (0.42 * wide, 0.42 * deep, 0.07))
        parts.append(
            Part(place(repeated(cushion, 2.0), (0, 0, seat + thick + 0.06)), materials.textured())
        )
    return parts


def bricks(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Studded toy bricks of many colors, stacked on a plate."""
    unit, height = 0.16, 0.19
    cells = int(rng.integers(6, 11))
    parts: list[Part] = []
    level = np.zeros((cells, cells), dtype=int)
    stud = lathe([(0.048, 0.0), (0.048, 0.034), (0.045, 0.036), (0.0, 0.036)], 14)
    paints = [
        materials.coated(color if rng.random() < 0.8 else materials.texture("printed"))
        for color in materials.colors
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
        parts.append(Part(block(size, at), paints[paint], False))
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
    plate = block(
        (cells * unit, cells * unit, 0.05), (0.5 * cells * unit, 0.5 * cells * unit, -0.05)
    )
    parts.append(Part(plate, materials.plain(), False))
    return parts


def cage(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Wires around a solid: a bird cage, a crate of rods or a ball of rings."""
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
                wires.append(rod((a, side, 0), (a, side, 1), thin))
                wires.append(rod((side, a, 0), (side, a, 1), thin))
                wires.append(rod((-0.5, side, a + 0.5), (0.5, side, a + 0.5), thin))
                wires.append(rod((side, -0.5, a + 0.5), (side, 0.5, a + 0.5), thin))
    else:
        ring = np.stack([0.55 * np.cos(t), 0.55 * np.sin(t), 0 * t], -1)
        for _ in range(count):
            wires.append(tube(ring @ random_turn(rng).T + [0, 0, 0.55], thin, True, 8))
    parts = [Part(joined(wires), materials.metal() if rng.random() < 0.5 else materials.plain())]
    meshes, smooth = random_solid(rng)
    inside = materials.textured()
    parts += [
        Part(transformed(mesh, 0.3 * random_turn(rng), (0, 0, 0.42)), inside, smooth)
        for mesh in meshes
    ]
    base = lathe([(0.0, -0.06), (0.72, -0.06), (0.72, 0.0), (0.0, 0.0)])
    parts.append(Part(base, materials.textured()))
    return parts


def machine(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """Boxes, gears on shafts, pipes and gauges on a base."""
    parts = [Part(block((1.5, 1.0, 0.12), (0, 0, 0)), materials.textured("rust", "speckle"), False)]
    for _ in range(int(rng.integers(2, 5))):
        size = rng.uniform(0.2, 0.6, 3)
        spot = rng.uniform([-0.5, -0.3], [0.5, 0.3])
        parts.append(Part(block(size, (*spot, 0.12)), materials.textured(), False))
    for _ in range(int(rng.integers(2, 6))):
        radius = rng.uniform(0.12, 0.35)
        outline = radius * gear(int(rng.integers(8, 22)), float(rng.uniform(0.12, 0.25)))
        wheel = joined(prism(outline, float(rng.uniform(0.05, 0.12)), levels=1))
        side = rng.choice([-1.0, 1.0])
        at = np.array([rng.uniform(-0.6, 0.6), side * rng.uniform(0.3, 0.5), rng.uniform(0.4, 0.8)])
        metal = materials.metal() if rng.random() < 0.5 else materials.textured("rust")
        parts.append(Part(transformed(wheel, rotation((1, 0, 0), math.pi / 2), at), metal, False))
        parts.append(Part(rod(at - [0, 0.45, 0], at + [0, 0.45, 0], 0.03), metal))
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
        parts.append(Part(rod((x * body[0], 0, leg + 0.3 * body[2]), foot, 0.055), trim))
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
    parts = [Part(block((length, width, 0.28), (0, 0, base), times=1.0), hull, False)]
    cabin_at = rng.uniform(-0.25, 0.25) * length
    cabin = block((rng.uniform(0.3, 0.6) * length, 0.9 * width, 0.34), (cabin_at, 0, base + 0.28))
    parts.append(Part(cabin, materials.textured("printed", "stripes", "speckle", "tiles"), False))
    nose = superquadric((0.5, 0.5), (0.25, 0.5 * width, 0.17))
    parts.append(Part(place(nose, (0.5 * length, 0, base + 0.14)), hull))
    profile = [(0.0, -0.06), (0.5 * wheel, -0.06), (0.6 * wheel, -0.09), (wheel, -0.08)]
    profile += [(wheel, 0.08), (0.6 * wheel, 0.09), (0.5 * wheel, 0.06), (0.0, 0.06)]
    tire = transformed(lathe(profile, 40), rotation((1, 0, 0), math.pi / 2))
    rubber = materials.coated(materials.texture("checker", "speckle", "stripes") * 0.4)
    axles = np.linspace(-0.38, 0.38, int(rng.integers(2, 5))) * length
    for x in axles:
        for side in (-1, 1):
            parts.append(Part(place(tire, (x, side * (0.5 * width + 0.05), wheel)), rubber))
        parts.append(Part(rod((x, -0.6 * width, wheel), (x, 0.6 * width, wheel), 0.05), trim))
    rails = []
    top = base + 0.28
    for x in np.linspace(-0.48, 0.48, int(rng.integers(4, 10))) * length:
        for y in (-0.48 * width, 0.48 * width):
            rails.append(rod((x, y, top), (x, y, top + 0.18), 0.012))
    for y in (-0.48 * width, 0.48 * width):
        start, end = (-0.48 * length, y, top + 0.18), (0.48 * length, y, top + 0.18)
        rails.append(rod(start, end, 0.014))
    parts.append(Part(joined(rails), materials.metal() if rng.random() < 0.5 else trim))
    if rng.random() < 0.6:
        joints = np.array([[-0.3 * length, 0, top], [0.0, 0, 0], [0.0, 0, 0], [0.0, 0, 0]])
        for index in range(1, 4):
            joints[index] = joints[index - 1] + rng.uniform([0.1, -0.1, -0.1], [0.45, 0.1, 0.5])
        for a, b in itertools.pairwise(joints):
            parts.append(Part(rod(a, b, 0.045), trim))
            parts.append(Part(place(superquadric((1, 1), [0.07] * 3, 16), b), hull))
        bucket = superquadric((0.3, 0.3), (0.16, 0.22, 0.1))
        parts.append(Part(place(bucket, joints[-1]), materials.textured("rust", "stripes")))
    return parts


def tower(rng: np.random.Generator, materials: Materials) -> list[Part]:
    """A house or tower with windows, columns, a roof and a fence."""
    parts: list[Part] = []
    height, wide = 0.0, rng.uniform(0.6, 1.0)
    stories = materials.textured("bricks", "stone", "tiles", "speckle")
    dark = materials.coated(0.25 * materials.color())
    for _ in range(int(rng.integers(1, 4))):
        floor, deep = rng.uniform(0.3, 0.6), wide * rng.uniform(0.7, 1.0)
        parts.append(Part(block((wide, deep, floor), (0, 0, height), times=2.0), stories, False))
        panes = []
        for x in np.linspace(-0.36, 0.36, int(rng.integers(2, 6))) * wide:
            for side in (-0.5, 0.5):
                panes.append(
                    block((0.09, 0.03, 0.45 * floor), (x, side * deep, height + 0.3 * floor))
                )
                panes.append(
                    block(
                        (0.03, 0.09, 0.45 * floor),
                        (side * wide, x * deep / wide, height + 0.3 * floor),
                    )
                )
        parts.append(Part(joined(panes), dark, False))
        ledge = block((1.06 * wide, 1.06 * deep, 0.04), (0, 0, height + floor))
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
        posts.append(rod((x, y, 0), (x, y, 0.2), 0.015))
    t = np.linspace(0, 2 * np.pi, 49)
    for z in (0.08, 0.17):
        posts.append(
            tube(np.stack([0.85 * np.cos(t), 0.85 * np.sin(t), 0 * t + z], -1), 0.012, True, 8)
        )
    parts.append(Part(joined(posts), materials.plain()))
    lawn = materials.coated(materials.texture("grass", "stone", "tiles"))
    parts.append(Part(disc(1.0), lawn))
    return parts
