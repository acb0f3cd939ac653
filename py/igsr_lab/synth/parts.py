"""Building blocks of random objects: moved, repeated and simple shapes, and random solids."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from igsr_lab.synth.description import Part
from igsr_lab.synth.meshes import (
    Mesh,
    box,
    gear,
    joined,
    lathe,
    lumpy_ball,
    place,
    prism,
    rotation,
    star,
    superquadric,
    transformed,
    tube,
)

#: A point or vector.
Vector = Sequence[float] | np.ndarray


def moved(parts: Sequence[Part], matrix: np.ndarray, at: Vector) -> list[Part]:
    """Map parts by x -> matrix x + at."""
    return [Part(transformed(part.mesh, matrix, at), part.material, part.smooth) for part in parts]


def bounds(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of the parts' bounding box."""
    lowest = np.min([part.mesh[0].min(axis=0) for part in parts], axis=0)
    highest = np.max([part.mesh[0].max(axis=0) for part in parts], axis=0)
    return lowest, highest


def repeated(mesh: Mesh, times: float) -> Mesh:
    """The mesh with its texture repeated ``times`` times."""
    return mesh[0], mesh[1], mesh[2] * times


def block(
    size: Vector,
    at: Vector,
    turn: float = 0.0,
    times: float = 1.0,
) -> Mesh:
    sides = joined(box((float(size[0]), float(size[1]), float(size[2]))))
    return repeated(place(sides, at, turn), times)


def rod(start: Vector, end: Vector, radius: float) -> Mesh:
    path = np.linspace(np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64), 3)
    return tube(path, radius, closed=False, around=12)


def random_turn(rng: np.random.Generator) -> np.ndarray:
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


def random_solid(rng: np.random.Generator) -> tuple[list[Mesh], bool]:
    """A random solid of size about 1, and whether it is smooth."""
    kind = rng.integers(7)
    if kind == 0:
        roundness = rng.uniform(0.15, 1.8, 2)
        size = rng.uniform(0.35, 1.0, 3)
        return [superquadric((roundness[0], roundness[1]), size)], True
    if kind == 1:
        return [lumpy_ball(rng, rng.uniform(0.1, 0.5), rng.uniform(0.5, 4.0))], True
    if kind == 2:
        return [block(rng.uniform(0.4, 1.5, 3), (0, 0, -0.5))], False
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
