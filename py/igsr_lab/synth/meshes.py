"""Triangle meshes of the objects and rooms of synthetic captures.

A mesh is (vertices [V, 3] float64, faces [F, 3] int, uv [V, 2] float64); z is up, lengths are in
world units, and winding does not matter, since materials are two-sided.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles for each cell of a sheet of points, int [2 (rows - 1) (columns - 1), 3]."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return triangles.reshape(-1, 3)


def grid_mesh(points: np.ndarray) -> Mesh:
    """A mesh of a sheet of points [rows, columns, 3], u along columns, v along rows."""
    rows, columns = points.shape[:2]
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    return points.reshape(-1, 3), grid_faces(rows, columns), np.stack([u, v], -1).reshape(-1, 2)


def lathe(profile: Sequence[tuple[float, float]], around: int = 96) -> Mesh:
    """A (radius, height) profile with rounded corners, revolved about z."""
    corners = np.array(profile)
    for _ in range(3):  # Chaikin's corner cutting, except the ends
        inner = np.empty((2 * len(corners) - 2, 2))
        inner[0::2] = 0.75 * corners[:-1] + 0.25 * corners[1:]
        inner[1::2] = 0.25 * corners[:-1] + 0.75 * corners[1:]
        corners = np.concatenate([corners[:1], inner, corners[-1:]])
    angle = np.linspace(0, 2 * np.pi, around + 1)
    radius, height = corners[:, :1], corners[:, 1:]
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle], axis=-1)
    vertices, faces, uv = grid_mesh(points)
    # v follows the height, so that bands are level on a curved wall.
    span = np.ptp(corners[:, 1])
    uv[:, 1] = (vertices[:, 2] - corners[:, 1].min()) / span
    return vertices, faces, uv


def tube(path: np.ndarray, radius: float, closed: bool, around: int = 24) -> Mesh:
    """A round tube around a path [P, 3]."""
    tangent = np.gradient(path, axis=0)
    if closed:
        tangent[0] = tangent[-1] = path[1] - path[-2]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # Parallel transport of the frame avoids twists.
    normal = np.cross(tangent[0], [0.31, 0.17, 0.93])
    rings = []
    angle = np.linspace(0, 2 * np.pi, around + 1)[:, None]
    for point, forward in zip(path, tangent, strict=True):
        normal = normal - forward * (normal @ forward)
        normal /= np.linalg.norm(normal)
        side = np.cross(forward, normal)
        rings.append(point + radius * (np.cos(angle) * normal + np.sin(angle) * side))
    return grid_mesh(np.stack(rings))


def box(size: tuple[float, float, float]) -> list[Mesh]:
    """The faces +x, -x, +y, -y, +z, -z of a box standing on z = 0, each with uv in [0, 1]^2."""
    sx, sy, sz = size
    faces = []
    for axis in range(3):
        for sign in (1, -1):
            unit = np.zeros(3)
            unit[axis] = sign
            across = np.cross([0, 0, 1], unit) if axis < 2 else np.array([0.0, sign, 0.0])
            up = np.cross(unit, across)
            corners = [
                unit + (2 * i - 1) * across + (1 - 2 * j) * up for j in (0, 1) for i in (0, 1)
            ]
            points = (np.array(corners).reshape(2, 2, 3) * 0.5 + [0, 0, 0.5]) * [sx, sy, sz]
            faces.append(grid_mesh(points))
    return faces


def place(mesh: Mesh, at: Sequence[float] | np.ndarray, turn: float = 0.0) -> Mesh:
    """Turn a mesh about z by ``turn`` radians, then move it by ``at``."""
    vertices, faces, uv = mesh
    cos, sin = math.cos(turn), math.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return vertices @ rotation.T + at, faces, uv


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted normals; vertices at the same place share one, so that seams are invisible."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    _, together = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    together = together.reshape(-1)
    total = np.zeros((together.max() + 1, 3))
    for i in range(3):
        np.add.at(total, together[faces[:, i]], face)
    normals = total[together]
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def transformed(
    mesh: Mesh, matrix: np.ndarray, at: Sequence[float] | np.ndarray = (0, 0, 0)
) -> Mesh:
    """Map a mesh by x -> matrix x + at; matrix [3, 3]."""
    vertices, faces, uv = mesh
    return vertices @ np.asarray(matrix).T + np.asarray(at), faces, uv


def rotation(axis: Sequence[float] | np.ndarray, angle: float) -> np.ndarray:
    """Rotation by ``angle`` radians about ``axis``, [3, 3] (Rodrigues' formula)."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def superquadric(
    roundness: tuple[float, float], size: Sequence[float] | np.ndarray, segments: int = 40
) -> Mesh:
    """A superquadric ellipsoid (Barr 1981) around the origin.

    Args:
        roundness: exponents along the meridian and around: 1 is an ellipsoid, towards 0 a box,
            2 an octahedron.
        size: half extents along x, y, z.
        segments: cells around; half as many from pole to pole.
    """

    def power(wave: np.ndarray, exponent: float) -> np.ndarray:
        return np.asarray(np.sign(wave) * np.abs(wave) ** exponent)

    polar = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)[:, None]
    around = np.linspace(-np.pi, np.pi, segments + 1)[None, :]
    ring = power(np.cos(polar), roundness[0])
    points = np.stack(
        [
            ring * power(np.cos(around), roundness[1]),
            ring * power(np.sin(around), roundness[1]),
            power(np.sin(polar), roundness[0]) + 0.0 * around,
        ],
        axis=-1,
    )
    return grid_mesh(points * np.asarray(size))


def lumpy_ball(rng: np.random.Generator, depth: float, waves: float, segments: int = 64) -> Mesh:
    """A unit ball whose radius is displaced by random plane waves.

    Args:
        rng: draws the waves.
        depth: maximum displacement in radii, under 1.
        waves: number of waves through the ball; many make rocks, few make potatoes.
        segments: cells around.
    """
    polar = np.linspace(0, np.pi, segments // 2 + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, segments + 1)[None, :]
    ball = np.stack(
        [
            np.sin(polar) * np.cos(around),
            np.sin(polar) * np.sin(around),
            np.cos(polar) + 0 * around,
        ],
        axis=-1,
    )
    # Close the seam and the poles exactly, despite rounding.
    ball[:, -1] = ball[:, 0]
    ball[[0, -1]] = ball[[0, -1], :1]
    directions = rng.normal(size=(8, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    frequency = waves * np.pi * rng.uniform(0.4, 1.4, 8)
    phase = rng.uniform(0, 2 * np.pi, 8)
    weight = 1.0 / frequency
    height = np.sin(ball @ directions.T * frequency + phase) @ (weight / weight.sum())
    return grid_mesh(ball * (1.0 + depth * height)[..., None])


def prism(
    outline: np.ndarray, height: float, twist: float = 0.0, taper: float = 1.0, levels: int = 12
) -> list[Mesh]:
    """The wall, bottom and top of an outline extruded along z from 0.

    Args:
        outline: [P, 2], star-shaped around the origin, not closed.
        height: of the top.
        twist: rotation of the top, radians.
        taper: size of the top relative to the bottom.
        levels: rows of the wall.
    """
    ring = np.concatenate([outline, outline[:1]])
    share = np.linspace(0, 1, levels + 1)
    angle, scale = twist * share, 1.0 + (taper - 1.0) * share
    cos, sin = np.cos(angle) * scale, np.sin(angle) * scale
    wall = np.stack(
        [
            cos[:, None] * ring[:, 0] - sin[:, None] * ring[:, 1],
            sin[:, None] * ring[:, 0] + cos[:, None] * ring[:, 1],
            np.broadcast_to(share[:, None] * height, (levels + 1, len(ring))),
        ],
        axis=-1,
    )
    reach = 2.0 * np.abs(outline).max()
    caps = []
    for level in (0, -1):
        center = np.broadcast_to([0.0, 0.0, wall[level, 0, 2]], wall[level].shape)
        vertices, faces, _ = grid_mesh(np.stack([center, wall[level]]))
        caps.append((vertices, faces, vertices[:, :2] / reach + 0.5))
    return [grid_mesh(wall), *caps]


def star(points: int, inner: float, per_edge: int = 1) -> np.ndarray:
    """Outline of a star, [2 points per_edge, 2], of radius 1 and smaller radius ``inner``."""
    corners = np.arange(2 * points)
    radius = np.where(corners % 2 == 0, 1.0, inner)
    angle = corners * np.pi / points
    tips = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    share = (np.arange(per_edge) / per_edge)[None, :, None]
    following = np.roll(tips, -1, axis=0)
    return (tips[:, None] * (1 - share) + following[:, None] * share).reshape(-1, 2)


def gear(teeth: int, depth: float) -> np.ndarray:
    """Outline of a gear of radius 1, [4 teeth, 2]; ``depth`` of its teeth."""
    angle = (np.arange(4 * teeth) + np.tile([0.0, 0.25, -0.25, 0.0], teeth)) * np.pi / (2 * teeth)
    radius = np.tile([1.0 - depth, 1.0, 1.0, 1.0 - depth], teeth)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def disc(radius: float, rings: int = 2, around: int = 48) -> Mesh:
    """A flat disc in z = 0, with a square texture."""
    angle = np.linspace(0, 2 * np.pi, around + 1)
    distance = np.linspace(0, radius, rings + 1)[:, None]
    points = np.stack(
        [distance * np.cos(angle), distance * np.sin(angle), 0 * distance * angle], axis=-1
    )
    vertices, faces, _ = grid_mesh(points)
    return vertices, faces, vertices[:, :2] / (2 * radius) + 0.5


def sheet(width: float, depth: float, heights: np.ndarray | None = None) -> Mesh:
    """A rectangle around the origin in z = 0, or at ``heights`` [rows, columns]."""
    heights = np.zeros((2, 2)) if heights is None else heights
    rows, columns = heights.shape
    y, x = np.meshgrid(
        np.linspace(-depth / 2, depth / 2, rows),
        np.linspace(-width / 2, width / 2, columns),
        indexing="ij",
    )
    return grid_mesh(np.stack([x, y, heights], -1))


def leaf(length: float, width: float, bend: float) -> Mesh:
    """A pointed leaf along +x from the origin, bent downwards by ``bend`` radians."""
    along = np.linspace(0, 1, 9)
    across = np.linspace(-1, 1, 5)
    half = 0.5 * width * np.sin(np.pi * along**0.8) ** 0.9
    half[[0, -1]] = 0.02 * width
    angle = bend * along
    step = length / (len(along) - 1)
    x = np.concatenate([[0.0], np.cumsum(np.cos(angle[:-1]) * step)])
    z = np.concatenate([[0.0], np.cumsum(-np.sin(angle[:-1]) * step)])
    y = half[:, None] * across
    fold = 0.35 * np.abs(y)  # the blade rises from its midrib
    points = np.stack(
        [np.broadcast_to(x[:, None], y.shape), y, np.broadcast_to(z[:, None], y.shape) + fold], -1
    )
    return grid_mesh(points)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes."""
    offsets = np.cumsum([0] + [len(mesh[0]) for mesh in meshes[:-1]])
    return (
        np.concatenate([mesh[0] for mesh in meshes]),
        np.concatenate([mesh[1] + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh[2] for mesh in meshes]),
    )
