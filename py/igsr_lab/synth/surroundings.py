"""Whole scenes: lone objects, or objects on a table, in a room, outdoors or on shelves."""

from __future__ import annotations

import math

import numpy as np

from igsr_lab.synth.description import Description, Light, Part
from igsr_lab.synth.materials import Materials
from igsr_lab.synth.meshes import Mesh, box, disc, joined, lathe, place, rotation, sheet, tube
from igsr_lab.synth.objects import OBJECTS, random_object
from igsr_lab.synth.parts import bounds, moved
from igsr_lab.synth.skies import SKIES, UNSEEN_SKIES, cloudy
from igsr_lab.synth.textures import landscape, noise, to_linear

#: Fraction of the scenes of family "object".
OBJECT_FRACTION = 0.45
#: Rooms and ground are less colorful than objects.
ROOM_VIVIDNESS = 0.1


def draw_description(rng: np.random.Generator) -> Description:
    """Draw a scene of one of the two families."""
    if rng.random() < OBJECT_FRACTION:
        return _lone_object(rng)
    kinds = (_table, _room, _outdoors, _corner, _shelves)
    return kinds[rng.integers(len(kinds))](rng)


def _turned(rng: np.random.Generator, parts: list[Part], size: float, at: np.ndarray) -> list[Part]:
    turn = rotation((0, 0, 1), float(rng.uniform(0, 2 * math.pi)))
    return moved(parts, size * turn, at)


def _cluster(rng: np.random.Generator, count: int) -> tuple[list[str], list[Part]]:
    """Objects next to each other on z = 0, within a circle of radius about 1."""
    names: list[str] = []
    parts: list[Part] = []
    taken: list[tuple[np.ndarray, float]] = []
    for index in range(count):
        size = float(rng.uniform(0.5, 0.8) if index == 0 else rng.uniform(0.2, 0.5))
        for _ in range(12):
            spot = rng.normal(0.0, 0.15 if index == 0 else 0.55, 2)
            if all(np.linalg.norm(at - spot) > 0.8 * (reach + size) for at, reach in taken):
                break
        else:
            continue
        name, made = random_object(rng)
        taken.append((spot, size))
        names.append(name)
        parts += _turned(rng, made, size, np.array([*spot, 0.0]))
    return names, parts


def _lamps(rng: np.random.Generator, reach: float, power: float) -> list[Light]:
    """At most two area lights high above the cameras."""
    lamps = []
    for _ in range(int(rng.integers(0, 3))):
        azimuth, height = rng.uniform(0, 2 * math.pi), rng.uniform(0.75, 0.95)
        ring = math.sqrt(1.0 - height**2)
        way = np.array([ring * math.cos(azimuth), ring * math.sin(azimuth), height])
        size = rng.uniform(0.12, 0.4, 2) * reach
        tint = to_linear(np.array([1.0, *rng.uniform(0.75, 1.0, 2)]))
        if rng.random() < 0.4:
            tint = tint[::-1]
        strength = power * rng.uniform(0.5, 2.0) * reach**2 / (4.0 * size[0] * size[1])
        lamps.append(
            Light(
                reach * way,
                rng.normal(0, 0.2, 3),
                (float(size[0]), float(size[1])),
                strength * tint,
            )
        )
    return lamps


def _framed(description: Description) -> Description:
    """Set ``center`` and ``radius`` by the objects."""
    lowest, highest = bounds(description.objects)
    description.center = 0.5 * (lowest + highest)
    description.radius = max(
        float(np.linalg.norm(part.mesh[0] - description.center, axis=1).max())
        for part in description.objects
    )
    return description


def _lone_object(rng: np.random.Generator) -> Description:
    count = int(rng.choice([1, 1, 1, 2, 4]))
    names, parts = _cluster(rng, count)
    if rng.random() < 0.3:
        materials = Materials(rng, ROOM_VIVIDNESS)
        reach = 1.1 * float(max(np.abs(part.mesh[0][:, :2]).max() for part in parts))
        base = materials.textured()
        if rng.random() < 0.5:
            plate = lathe([(0.0, -0.1), (reach, -0.1), (reach, 0.0), (0.0, 0.0)], 96)
            parts.append(Part(plate, base))
        else:
            plate = place(joined(box((2 * reach, 2 * reach, 0.1))), (0, 0, -0.1))
            parts.append(Part(plate, base, smooth=False))
    sky = UNSEEN_SKIES[rng.integers(len(UNSEEN_SKIES))](rng)
    return _framed(Description("object", "none", names, parts, sky, lights=_lamps(rng, 6.0, 1.2)))


def _upright(wide: float, tall: float, off: float, along: float, foot: float) -> Mesh:
    """A rectangle across the x axis at ``off``, around y = ``along``, from ``foot`` up."""
    vertices, faces, uv = sheet(wide, tall)
    return vertices[:, [2, 0, 1]] + [off, along, foot + 0.5 * tall], faces, uv


def _walls(
    rng: np.random.Generator, materials: Materials, floor: float, sides: dict[int, float]
) -> list[Part]:
    """A floor and walls, with pictures and a skirting board.

    Args:
        rng: draws the textures.
        materials: of the room.
        floor: height of the floor.
        sides: distances of the walls from the origin by side, 0 to 3 for +x, +y, -x, -y.
    """
    reach = 2.2 * max(2.5, *sides.values())
    height = float(rng.uniform(0.4, 0.6)) * reach
    ground = materials.textured("wood", "tiles", "checker", "stone", "cells", "plaid", "speckle")
    vertices, faces, uv = sheet(reach, reach)
    parts = [Part((vertices + [0, 0, floor], faces, uv * rng.integers(2, 6)), ground, False)]
    kinds = ("bricks", "stripes", "speckle", "clouds", "tiles", "dots", "wood", "stone", "plaid")
    same = materials.textured(*kinds)
    trim = materials.plain()
    for side, distance in sides.items():
        paper = same if rng.random() < 0.6 else materials.textured(*kinds)
        turn = rotation((0, 0, 1), side * math.pi / 2)

        vertices, faces, uv = _upright(reach, height, distance, 0.0, floor)
        times = [reach / height * 2, 2.0]
        parts += moved([Part((vertices, faces, uv * times), paper, False)], turn, (0, 0, 0))
        board = _upright(reach, 0.06 * height, distance - 0.02, 0.0, floor)
        parts += moved([Part(board, trim, False)], turn, (0, 0, 0))
        for along in np.arange(-0.35, 0.4, 0.35) * reach:
            if rng.random() < 0.7:
                wide, tall = rng.uniform(0.12, 0.3, 2) * height
                foot = floor + rng.uniform(0.25, 0.6) * height
                art = landscape(rng, 128) if rng.random() < 0.5 else materials.texture()
                picture = _upright(wide, tall, distance - 0.04, along, foot)
                frame = _upright(
                    1.12 * wide, 1.12 * tall, distance - 0.03, along, foot - 0.06 * tall
                )
                parts += moved(
                    [Part(picture, materials.coated(art), False), Part(frame, trim, False)],
                    turn,
                    (0, 0, 0),
                )
    return parts


def _ceiling(rng: np.random.Generator, room: float, parts: list[Part]) -> list[Light]:
    """A luminous ceiling as large as the room, and sometimes a lamp below it.

    Most light paths to a sky above open walls would end at a wall.
    """
    height = 0.99 * float(bounds(parts)[1][2])
    tint = to_linear(np.array([1.0, *rng.uniform(0.85, 1.0, 2)]))
    lights = [Light(np.array([0, 0, height]), np.zeros(3), (1.1 * room, 1.1 * room), tint)]
    if rng.random() < 0.3:
        at = np.array([*rng.uniform(-0.7, 0.7, 2) * room, 0.9 * height])
        size = float(rng.uniform(0.2, 0.6))
        lights.append(Light(at, rng.normal(0, 0.3, 3), (size, size), 8.0 / size * tint[::-1]))
    return lights


def _bystanders(
    rng: np.random.Generator,
    count: int,
    near: float,
    far: float,
    floor: float,
    sizes: tuple[float, float],
) -> list[Part]:
    """Objects around the scene, between two distances from the origin."""
    parts: list[Part] = []
    for _ in range(count):
        _, made = random_object(rng)
        azimuth, distance = rng.uniform(0, 2 * math.pi), rng.uniform(near, far)
        at = np.array([distance * math.cos(azimuth), distance * math.sin(azimuth), floor])
        parts += _turned(rng, made, float(rng.uniform(*sizes)), at)
    return parts


def _table(rng: np.random.Generator) -> Description:
    names, objects = _cluster(rng, int(rng.integers(2, 6)))
    materials = Materials(rng, ROOM_VIVIDNESS)
    reach, floor = float(rng.uniform(1.2, 2.0)), -float(rng.uniform(0.8, 1.4))
    top = materials.textured("wood", "marble", "plaid", "checker", "speckle", "stone", "tiles")
    parts = []
    if rng.random() < 0.5:
        vertices, faces, uv = disc(reach)
        rim = lathe([(reach, -0.001), (1.02 * reach, -0.02), (reach, -0.08), (0.0, -0.08)])
        parts += [Part((vertices, faces, 2 * uv), top), Part(rim, materials.plain())]
        foot = [(0.08, -0.08), (0.1, 0.6 * floor), (0.5, floor + 0.05), (0.5, floor)]
        parts.append(Part(lathe(foot), materials.plain()))
    else:
        deep = reach * float(rng.uniform(0.7, 1.0))
        vertices, faces, uv = joined(box((2 * reach, 2 * deep, 0.08)))
        parts.append(Part((vertices - [0, 0, 0.08], faces, 2 * uv), top, smooth=False))
        legs = [
            tube(np.array([[x, y, -0.08], [x, y, 0.5 * floor], [x, y, floor]]), 0.06, False, 12)
            for x in (-0.9 * reach, 0.9 * reach)
            for y in (-0.9 * deep, 0.9 * deep)
        ]
        parts.append(Part(joined(legs), materials.plain()))
    sky: np.ndarray | None = SKIES[rng.integers(len(SKIES))](rng)
    lamps = _lamps(rng, 7.0, 1.0)
    room = np.inf
    if rng.random() < 0.6:
        room = float(rng.uniform(4.0, 6.0))
        parts += _walls(rng, materials, floor, dict.fromkeys(range(4), room))
        sky, lamps = None, _ceiling(rng, room, parts)
        parts += _bystanders(
            rng, int(rng.integers(1, 5)), 0.75 * room, 0.85 * room, floor, (0.4, 0.8)
        )
    else:
        ground = materials.textured("wood", "tiles", "stone", "grass", "cells")
        vertices, faces, uv = disc(float(rng.uniform(4.0, 9.0)))
        parts.append(Part((vertices + [0, 0, floor], faces, 6 * uv), ground))
    return _framed(
        Description("surroundings", "table", names, objects, sky, parts, lamps, room=room)
    )


def _room(rng: np.random.Generator) -> Description:
    names, objects = _cluster(rng, int(rng.integers(1, 5)))
    materials = Materials(rng, ROOM_VIVIDNESS)
    room = float(rng.uniform(3.0, 5.0))
    sides = {side: room * float(rng.uniform(1.0, 1.3)) for side in range(4)}
    parts = _walls(rng, materials, 0.0, sides)
    parts += _bystanders(rng, int(rng.integers(2, 7)), 0.75 * room, 0.9 * room, 0.0, (0.4, 0.9))
    lamps = _ceiling(rng, room, parts)
    return _framed(
        Description("surroundings", "room", names, objects, None, parts, lamps, room=0.7 * room)
    )


def _outdoors(rng: np.random.Generator) -> Description:
    names, objects = _cluster(rng, int(rng.integers(1, 5)))
    materials = Materials(rng, ROOM_VIVIDNESS)
    size, cells = 36.0, 96
    heights = rng.uniform(0.5, 3.0) * (noise(rng, cells, cells, (8, 8)) - 0.5)
    x, y = np.meshgrid(np.linspace(-1, 1, cells), np.linspace(-1, 1, cells))
    # Level near the objects and cameras.
    heights *= np.clip((np.hypot(x, y) - 0.2) * 3.0, 0.0, 1.0)
    vertices, faces, uv = sheet(size, size, heights)
    earth = materials.textured("grass", "grass", "stone", "cells", "bricks", "tiles")
    parts = [Part((vertices, faces, uv * rng.integers(10, 24)), earth)]
    if rng.random() < 0.4:
        patch = materials.textured("cells", "tiles", "wood", "stone")
        vertices, faces, uv = disc(float(rng.uniform(1.2, 2.0)))
        parts.append(Part((vertices + [0, 0, 0.01], faces, 2 * uv), patch))
    parts += _bystanders(rng, int(rng.integers(3, 9)), 5.0, 11.0, 0.0, (0.7, 2.5))
    sky = cloudy(rng)
    return _framed(Description("surroundings", "outdoors", names, objects, sky, parts, room=4.0))


def _corner(rng: np.random.Generator) -> Description:
    """Objects or plants at one or two walls, seen from the open side."""
    names, objects = _cluster(rng, int(rng.integers(2, 6)))
    if rng.random() < 0.4:
        for _ in range(int(rng.integers(1, 4))):
            made = OBJECTS["plant"](rng, Materials(rng))
            spot = np.array([*rng.normal(0.0, 0.6, 2), 0.0])
            objects += _turned(rng, made, float(rng.uniform(0.5, 0.9)), spot)
            names.append("plant")
    materials = Materials(rng, ROOM_VIVIDNESS)
    behind = float(bounds(objects)[1][:2].max() + rng.uniform(0.05, 1.0))
    sides = {0: behind} if rng.random() < 0.5 else {0: behind, 1: behind}
    parts = _walls(rng, materials, 0.0, sides)
    floor = materials.textured("wood", "tiles", "stone", "plaid")
    vertices, faces, uv = sheet(14.0, 14.0)
    parts.append(Part((vertices - [0, 0, 0.01], faces, 5 * uv), floor, False))
    sky = SKIES[rng.integers(len(SKIES))](rng)
    open_towards = math.pi if len(sides) == 1 else 1.25 * math.pi
    return _framed(
        Description(
            "surroundings",
            "corner",
            names,
            objects,
            sky,
            parts,
            _lamps(rng, 6.0, 1.0),
            open_towards=open_towards,
        )
    )


def _shelves(rng: np.random.Generator) -> Description:
    """Rows of objects on boards at a wall, seen from -x."""
    materials = Materials(rng, ROOM_VIVIDNESS)
    wide, deep = float(rng.uniform(2.2, 3.6)), float(rng.uniform(0.6, 0.9))
    boards, gap = int(rng.integers(1, 4)), float(rng.uniform(0.8, 1.1))
    wood = materials.textured("wood", "speckle", "marble")
    names: list[str] = []
    objects: list[Part] = []
    parts: list[Part] = []
    for board in range(boards + 1):
        vertices, faces, uv = joined(box((deep, wide, 0.05)))
        height = board * gap
        parts.append(Part((vertices + [0, 0, height - 0.05], faces, uv), wood, smooth=False))
        along = -0.5 * wide
        while board < boards:
            size = float(rng.uniform(0.2, 0.42))
            along += size
            if along + size > 0.5 * wide:
                break
            name, made = random_object(rng)
            tall = float(bounds(made)[1][2])
            size = min(size, 0.9 * gap / tall)
            objects += _turned(rng, made, size, np.array([rng.normal(0, 0.04), along, height]))
            names.append(name)
            along += size + float(rng.uniform(0.0, 0.3))
    for side in (-0.5, 0.5):
        vertices, faces, uv = joined(box((deep, 0.05, boards * gap + 0.05)))
        parts.append(Part((vertices + [0, side * wide, -0.05], faces, uv), wood, smooth=False))
    parts += _walls(rng, materials, -float(rng.uniform(0.05, 0.8)), {0: 0.55 * deep + 0.1 + 1e-3})
    sky = UNSEEN_SKIES[rng.integers(2)](rng)
    return _framed(
        Description(
            "surroundings",
            "shelves",
            names,
            objects,
            sky,
            parts,
            _lamps(rng, 7.0, 1.0),
            open_towards=math.pi,
        )
    )
