"""Renders the example capture: a small table laid for tea, photographed from all around.

    make example-capture

or, where igsr and ``examples/requirements.txt`` are installed,

    python examples/make_capture.py --out examples/tea_table

Everything in the scene is made here: the meshes and textures with numpy, the light and the photos
with Mitsuba 3 (``scalar_rgb``, which needs no driver). The capture is in the NeRF-Synthetic layout:
``transforms_train.json`` and ``transforms_test.json`` (``camera_angle_x``, camera-to-world matrices
in OpenGL axes, ``file_path`` without ``.png``) beside 8-bit sRGB PNGs with straight alpha.

The same seed gives the same files. Before any photo is taken, the cameras are checked: small lamps
at known places are rendered through them and must appear where the written matrices project them.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

mi.set_variant("scalar_rgb")

SIZE = 256
FIELD_OF_VIEW = math.radians(36.0)
DISTANCE = 4.3
TARGET = np.array([0.0, 0.0, 0.28])
TRAIN_VIEWS = 40
TEST_VIEWS = 8
SEED = 20

Scene = dict[str, Any]
Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices [V,3], faces [F,3], uv [V,2]


# ---- cameras ----------------------------------------------------------------------------------


def camera_to_world(azimuth: float, elevation: float, distance: float = DISTANCE) -> np.ndarray:
    """[4,4] camera-to-world in OpenGL axes, looking at TARGET, world z up."""
    back = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0] = right
    matrix[:3, 1] = np.cross(back, right)
    matrix[:3, 2] = back
    matrix[:3, 3] = TARGET + distance * back
    return matrix


def train_cameras(rng: np.random.Generator) -> list[np.ndarray]:
    """A jittered golden-angle spiral over the part of the upper hemisphere a person would walk."""
    cameras = []
    for i in range(TRAIN_VIEWS):
        height = (i + 0.5) / TRAIN_VIEWS  # uniform in sin(elevation): uniform over the sphere
        elevation = math.asin(0.08 + 0.84 * height)
        azimuth = i * math.pi * (3.0 - math.sqrt(5.0)) + rng.uniform(-0.1, 0.1)
        cameras.append(camera_to_world(azimuth, elevation, DISTANCE * rng.uniform(0.95, 1.05)))
    return cameras


def test_cameras() -> list[np.ndarray]:
    """One turn around the table, rising and falling between the training views."""
    turns = [2.0 * math.pi * (i + 0.25) / TEST_VIEWS for i in range(TEST_VIEWS)]
    return [
        camera_to_world(turn, math.radians(30.0 + 14.0 * math.sin(2.0 * turn))) for turn in turns
    ]


def sensor(matrix: np.ndarray, samples: int, seed: int) -> mi.Sensor:
    # Mitsuba's camera looks along +z with x to the left: turned half round the y axis.
    to_world = matrix @ np.diag([-1.0, 1.0, -1.0, 1.0])
    description: Scene = {
        "type": "perspective",
        "fov": math.degrees(FIELD_OF_VIEW),
        "fov_axis": "x",
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": {
            "type": "hdrfilm",
            "width": SIZE,
            "height": SIZE,
            "pixel_format": "rgba",
            # Each pixel is the plain average over its own square, as of a camera's photosite.
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter", "sample_count": samples, "seed": seed},
    }
    return mi.load_dict(description)


def take_photo(scene: mi.Scene, matrix: np.ndarray, samples: int, seed: int) -> np.ndarray:
    """Linear premultiplied RGBA float32 [H,W,4]."""
    return np.array(mi.render(scene, sensor=sensor(matrix, samples, seed), spp=samples, seed=seed))


def encode(linear: np.ndarray) -> np.ndarray:
    """Premultiplied linear RGBA -> straight 8-bit sRGB RGBA, black where nothing was hit."""
    alpha = np.clip(linear[..., 3:], 0.0, 1.0)
    colour = np.clip(linear[..., :3] / np.maximum(alpha, 1e-6), 0.0, 1.0)
    srgb = np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)
    pixels = np.round(255.0 * np.concatenate([srgb, alpha], axis=-1)).astype(np.uint8)
    pixels[pixels[..., 3] == 0] = 0
    return pixels


def check_cameras(cameras: list[np.ndarray], tolerance: float = 0.05) -> float:
    """Renders lamps at known places; returns the largest error in pixels of where they appear."""
    lamps = TARGET + np.array([[0.8, 0, 0], [0, 0.7, 0.2], [-0.6, -0.5, 0], [0.1, 0.2, 0.6]])
    radius = 0.03
    focal = 0.5 * SIZE / math.tan(0.5 * FIELD_OF_VIEW)
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    worst = 0.0
    for lamp in lamps:
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct"},
                "lamp": {
                    "type": "sphere",
                    "center": lamp.tolist(),
                    "radius": radius,
                    "emitter": {"type": "area", "radiance": 1.0},
                },
            }
        )
        for matrix in cameras:
            right, up, back = (lamp - matrix[:3, 3]) @ matrix[:3, :3]
            expected = np.array([right, -up]) / -back * focal + 0.5 * SIZE
            weight = take_photo(scene, matrix, samples=64, seed=0)[..., 3]
            seen = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
            worst = max(worst, float(np.linalg.norm(seen - expected)))
    if worst > tolerance:
        raise SystemExit(f"a lamp appears {worst:.2f} pixels from where its camera projects it")
    return worst


# ---- textures: sRGB in [0,1], float32 [H,W,3] -------------------------------------------------


def noise(rng: np.random.Generator, height: int, width: int, cells: tuple[int, int]) -> np.ndarray:
    """Smooth noise in [0,1] that repeats at the edges: cosine-blended random values."""
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


def wood_texture(rng: np.random.Generator) -> np.ndarray:
    """Six planks, each with its own tone and grain."""
    size, planks = 768, 6
    across = np.arange(size) / size * planks
    plank = across.astype(int)
    streaks = noise(rng, size, size, (192, 5)) * 0.6 + noise(rng, size, size, (48, 3)) * 0.4
    shift = rng.integers(0, size, planks)
    streaks = np.stack([np.roll(streaks[row], shift[plank[row]]) for row in range(size)])
    tone = rng.uniform(-0.18, 0.18, planks)[plank][:, None]
    picture = mix([0.38, 0.21, 0.11], [0.80, 0.56, 0.33], np.clip(streaks + tone, 0, 1))
    gap = np.minimum(across % 1, 1 - across % 1) < 0.03
    picture[gap] *= 0.35
    return picture


def cloth_texture() -> np.ndarray:
    """A checked napkin with a woven border."""
    size = 384
    u, v = np.meshgrid(np.arange(size) / size, np.arange(size) / size)
    check = ((u * 9).astype(int) % 2 + (v * 9).astype(int) % 2) / 2.0
    picture = mix([0.95, 0.93, 0.87], [0.72, 0.10, 0.12], check)
    edge = np.minimum.reduce([u, v, 1 - u, 1 - v])
    picture[(edge < 0.055) & (edge > 0.03)] = [0.16, 0.2, 0.42]
    weave = 0.94 + 0.06 * np.sin(u * 2 * np.pi * 96) * np.sin(v * 2 * np.pi * 96)
    return picture * weave[..., None]


def glaze_texture(rng: np.random.Generator) -> np.ndarray:
    """White china painted blue: bands, a zigzag and a row of flowers; u goes round, v up."""
    height, width = 384, 1024
    v, u = np.meshgrid(np.arange(height) / height, np.arange(width) / width, indexing="ij")
    picture = np.ones((height, width, 3)) * [0.93, 0.94, 0.92]
    blue, deep = np.array([0.16, 0.31, 0.66]), np.array([0.08, 0.13, 0.40])
    for low, high, paint in [(0.10, 0.13, deep), (0.15, 0.16, blue), (0.86, 0.90, deep)]:
        picture[(v > low) & (v < high)] = paint
    zigzag = 0.76 + 0.035 * (2 * np.abs((u * 24) % 1 - 0.5) * 2 - 1)
    picture[np.abs(v - zigzag) < 0.012] = blue
    flowers = 8
    x = ((u * flowers) % 1 - 0.5) * 2.2
    y = (v - 0.45) / 0.20
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    turn = np.floor(u * flowers) * 0.7
    picture[radius < 0.62 + 0.28 * np.cos(5 * angle + turn)] = blue
    picture[radius < 0.34 + 0.16 * np.cos(5 * angle + turn)] = [0.62, 0.76, 0.92]
    picture[radius < 0.16] = [0.93, 0.71, 0.20]
    return picture * (0.97 + 0.03 * noise(rng, height, width, (48, 128)))[..., None]


def orange_texture(rng: np.random.Generator) -> np.ndarray:
    height, width = 256, 512
    skin = noise(rng, height, width, (72, 144)) * 0.6 + noise(rng, height, width, (8, 16)) * 0.4
    picture = mix([0.86, 0.38, 0.05], [0.99, 0.62, 0.14], skin)
    v = (np.arange(height) / height)[:, None] * np.ones((1, width))
    picture[v < 0.035] = [0.30, 0.36, 0.12]
    return picture


def book_texture(rng: np.random.Generator, cover: list[float], ink: list[float]) -> np.ndarray:
    """A cover with a frame, a title of block letters and a printed roundel."""
    size = 384
    u, v = np.meshgrid(np.arange(size) / size, np.arange(size) / size)
    picture = np.ones((size, size, 3)) * cover
    picture *= (0.9 + 0.1 * noise(rng, size, size, (96, 96)))[..., None]
    edge = np.minimum.reduce([u, v, 1 - u, 1 - v])
    picture[(edge > 0.05) & (edge < 0.065)] = ink
    letters = rng.random((2, 7, 5, 3)) < 0.62
    for line, top in enumerate((0.16, 0.31)):
        for column in range(7):
            for row in range(5):
                for bar in range(3):
                    if letters[line, column, row, bar]:
                        left, upper = 0.16 + column * 0.1 + bar * 0.025, top + row * 0.022
                        stroke = (
                            (u >= left) & (u < left + 0.025) & (v >= upper) & (v < upper + 0.022)
                        )
                        picture[stroke] = ink
    radius = np.hypot(u - 0.5, v - 0.68)
    picture[(radius < 0.2) & ((radius * 40).astype(int) % 2 == 0)] = ink
    return picture


def page_texture(rng: np.random.Generator) -> np.ndarray:
    """The cut edge of a block of paper."""
    lines = rng.uniform(0.72, 1.0, (64, 1, 1)) * np.array([0.96, 0.92, 0.82])
    return np.broadcast_to(lines, (64, 16, 3)).copy()


def die_texture() -> np.ndarray:
    """Six faces side by side, each a square of an ivory die."""
    size = 96
    pips = [
        [(0.5, 0.5)],
        [(0.25, 0.25), (0.75, 0.75)],
        [(0.25, 0.25), (0.5, 0.5), (0.75, 0.75)],
        [(0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)],
        [(0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75), (0.5, 0.5)],
        [(x, y) for x in (0.28, 0.72) for y in (0.2, 0.5, 0.8)],
    ]
    picture = np.ones((size, 6 * size, 3)) * [0.95, 0.92, 0.83]
    u, v = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size)
    for face, dots in enumerate(pips):
        for x, y in dots:
            picture[:, face * size : (face + 1) * size][np.hypot(u - x, v - y) < 0.1] = [0.1] * 3
    return picture


def bitmap(picture: np.ndarray) -> Scene:
    linear = np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(linear.astype(np.float32)),
        "raw": True,
        "wrap_mode": "repeat",
    }


# ---- meshes -----------------------------------------------------------------------------------


def grid_faces(rows: int, columns: int) -> np.ndarray:
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return triangles.reshape(-1, 3)


def grid_mesh(points: np.ndarray) -> Mesh:
    """A mesh over a [rows, columns, 3] sheet of points, u along columns, v along rows."""
    rows, columns = points.shape[:2]
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    return points.reshape(-1, 3), grid_faces(rows, columns), np.stack([u, v], -1).reshape(-1, 2)


def lathe(profile: list[tuple[float, float]], around: int = 96) -> Mesh:
    """The (radius, height) profile turned about z, its corners rounded."""
    corners = np.array(profile)
    for _ in range(3):  # Chaikin's corner cutting, the ends kept
        inner = np.empty((2 * len(corners) - 2, 2))
        inner[0::2] = 0.75 * corners[:-1] + 0.25 * corners[1:]
        inner[1::2] = 0.25 * corners[:-1] + 0.75 * corners[1:]
        corners = np.concatenate([corners[:1], inner, corners[-1:]])
    angle = np.linspace(0, 2 * np.pi, around + 1)
    radius, height = corners[:, :1], corners[:, 1:]
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle], axis=-1)
    vertices, faces, uv = grid_mesh(points)
    # v follows the height, so that painted bands stay level on a curved wall.
    span = np.ptp(corners[:, 1])
    uv[:, 1] = (vertices[:, 2] - corners[:, 1].min()) / span
    return vertices, faces, uv


def tube(path: np.ndarray, radius: float, closed: bool, around: int = 24) -> Mesh:
    """A round tube about a [P,3] path; radius in scene units."""
    tangent = np.gradient(path, axis=0)
    if closed:
        tangent[0] = tangent[-1] = path[1] - path[-2]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # The frame is carried along the path (parallel transport), so that the tube does not twist.
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
    """The faces +x, -x, +y, -y, +z, -z of a box standing on z = 0, each with its own [0,1]^2."""
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


def place(mesh: Mesh, at: tuple[float, float, float], turn: float = 0.0) -> Mesh:
    vertices, faces, uv = mesh
    cos, sin = math.cos(turn), math.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return vertices @ rotation.T + at, faces, uv


def shape(mesh: Mesh, material: Scene, smooth: bool = True) -> mi.Mesh:
    vertices, faces, uv = mesh
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict({"type": "twosided", "bsdf": material})
    properties["face_normals"] = not smooth
    result = mi.Mesh(
        "mesh",
        vertex_count=len(vertices),
        face_count=len(faces),
        has_vertex_normals=smooth,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    if smooth:
        parameters["vertex_normals"] = vertex_normals(vertices, faces).astype(np.float32).ravel()
    parameters.update()
    return result


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted; vertices that lie together (a seam) share one normal, so that none shows."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    _, together = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    together = together.reshape(-1)
    total = np.zeros((together.max() + 1, 3))
    for i in range(3):
        np.add.at(total, together[faces[:, i]], face)
    normals = total[together]
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


# ---- the scene --------------------------------------------------------------------------------


def matte(colour: Any) -> Scene:
    if isinstance(colour, np.ndarray):
        return {"type": "diffuse", "reflectance": bitmap(colour)}
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}


def glossy(colour: Any, roughness: float) -> Scene:
    reflectance = matte(colour)["reflectance"]
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": roughness,
        "diffuse_reflectance": reflectance,
        "nonlinear": True,
    }


def metal(name: str, roughness: float) -> Scene:
    return {"type": "roughconductor", "material": name, "distribution": "ggx", "alpha": roughness}


def build_scene() -> mi.Scene:
    rng = np.random.default_rng(SEED)
    shapes: list[mi.Mesh] = []

    def add(mesh: Mesh, material: Scene, smooth: bool = True) -> None:
        shapes.append(shape(mesh, material, smooth))

    # The table: a disc of planks (uv over its square), a turned rim, a foot.
    angle, radius = np.linspace(0, 2 * np.pi, 129), np.linspace(0, 1.15, 9)
    disc = np.stack(
        [
            radius[:, None] * np.cos(angle),
            radius[:, None] * np.sin(angle),
            0 * radius[:, None] * angle,
        ],
        axis=-1,
    )
    vertices, faces, _ = grid_mesh(disc)
    wood = wood_texture(rng)
    add((vertices, faces, vertices[:, :2] / 2.3 + 0.5), glossy(wood, 0.25))
    rim = [(1.15, 0.0), (1.19, -0.01), (1.20, -0.05), (1.17, -0.09), (1.08, -0.10), (0.16, -0.10)]
    rim += [(0.09, -0.16), (0.08, -0.30), (0.15, -0.36), (0.40, -0.40), (0.40, -0.43), (0.0, -0.43)]
    add(lathe(rim), glossy([0.14, 0.055, 0.025], 0.2))

    # The napkin, a little wavy, under the teapot.
    u, v = np.meshgrid(np.linspace(-1, 1, 49), np.linspace(-1, 1, 49))
    wave = 0.006 + 0.006 * (1 + np.sin(5 * u + 2 * v)) * (u * u + v * v) / 2
    napkin = grid_mesh(np.stack([0.62 * u, 0.62 * v, wave], -1))
    add(place(napkin, (-0.18, 0.2, 0.0), 0.5), matte(cloth_texture()))

    # The teapot: body and lid on the lathe, spout and handle as tubes.
    china = glossy(glaze_texture(rng), 0.08)
    plain = glossy([0.86, 0.87, 0.84], 0.08)
    pot = (-0.2, 0.22, 0.02)
    body = [
        (0.0, 0.0),
        (0.22, 0.0),
        (0.24, 0.03),
        (0.40, 0.16),
        (0.42, 0.32),
        (0.32, 0.47),
        (0.19, 0.52),
    ]
    add(place(lathe(body), pot, 0.4), china)
    lid = [
        (0.20, 0.51),
        (0.205, 0.53),
        (0.15, 0.57),
        (0.05, 0.60),
        (0.025, 0.62),
        (0.06, 0.66),
        (0.05, 0.70),
        (0.0, 0.71),
    ]
    add(place(lathe(lid), pot), glossy([0.05, 0.09, 0.30], 0.08))
    t = np.linspace(0, 1, 32)[:, None]
    bend = (1 - t) ** 3 * [0.34, 0, 0.14] + 3 * t * (1 - t) ** 2 * [0.60, 0, 0.12]
    bend = bend + 3 * t * t * (1 - t) * [0.50, 0, 0.42] + t**3 * [0.70, 0, 0.50]
    add(place(tube(bend, 0.045, closed=False), pot, 0.4), plain)
    t = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 40)
    grip = np.stack([-0.36 - 0.22 * np.cos(t), 0 * t, 0.28 + 0.15 * np.sin(t)], -1)
    add(place(tube(grip, 0.032, closed=False), pot, 0.4), plain)

    # A cup on its saucer, with tea in it.
    cup = (0.52, 0.30, 0.0)
    saucer = [
        (0.0, 0.012),
        (0.10, 0.012),
        (0.20, 0.03),
        (0.245, 0.055),
        (0.25, 0.05),
        (0.2, 0.02),
        (0.1, 0.0),
        (0.0, 0.0),
    ]
    add(place(lathe(saucer), cup), glossy([0.10, 0.18, 0.46], 0.1))
    wall = [
        (0.0, 0.02),
        (0.08, 0.02),
        (0.09, 0.035),
        (0.15, 0.11),
        (0.165, 0.21),
        (0.16, 0.212),
        (0.14, 0.11),
        (0.08, 0.05),
        (0.0, 0.045),
    ]
    add(place(lathe(wall), cup, 1.0), china)
    add(
        place(lathe([(0.0, 0.165), (0.14, 0.165), (0.152, 0.168)]), cup),
        glossy([0.22, 0.06, 0.012], 0.05),
    )
    t = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 24)
    ear = np.stack([0.145 + 0.07 * np.cos(t), 0 * t, 0.125 + 0.05 * np.sin(t)], -1)
    add(place(tube(ear, 0.014, closed=False), cup, -0.9), plain)

    # Two books, one across the other.
    inks = [([0.10, 0.30, 0.26], [0.90, 0.78, 0.42]), ([0.52, 0.12, 0.16], [0.93, 0.88, 0.76])]
    places = [
        ((0.02, -0.58, 0.0), 0.35, (0.72, 0.52, 0.11)),
        ((0.05, -0.57, 0.11), -0.1, (0.58, 0.42, 0.09)),
    ]
    for (cover, ink), (at, turn, size) in zip(inks, places, strict=True):
        printed, pages = book_texture(rng, cover, ink), page_texture(rng)
        for index, mesh in enumerate(box(size)):
            paper = index in (0, 2, 3)
            add(
                place(mesh, at, turn), matte(pages) if paper else glossy(printed, 0.3), smooth=False
            )

    # Fruit, a die, a copper knot and a glazed marble.
    t = np.linspace(0, np.pi, 49)[:, None]
    angle = np.linspace(0, 2 * np.pi, 97)
    ball = np.stack(
        [np.sin(t) * np.cos(angle), np.sin(t) * np.sin(angle), np.cos(t) + 0 * angle], -1
    )
    orange = grid_mesh(0.155 * ball * [1, 1, 0.94])
    add(place(orange, (-0.62, -0.42, 0.147)), glossy(orange_texture(rng), 0.25))
    add(place(grid_mesh(0.085 * ball), (0.82, -0.22, 0.085)), glossy([0.02, 0.22, 0.24], 0.04))
    dots = die_texture()
    for face, (vertices, faces, uv) in enumerate(box((0.13, 0.13, 0.13))):
        uv = (uv + [face, 0]) / [6, 1]
        add(
            place((vertices, faces, uv), (-0.86, -0.02, 0.0), 0.6), glossy(dots, 0.15), smooth=False
        )
    t = np.linspace(0, 2 * np.pi, 241)
    ring = 0.10 + 0.045 * np.cos(3 * t)
    knot = np.stack([ring * np.cos(2 * t), ring * np.sin(2 * t), 0.045 * np.sin(3 * t)], -1)
    add(place(tube(knot, 0.026, closed=True), (0.06, -0.57, 0.268)), metal("Cu", 0.22))

    scene: Scene = {
        "type": "scene",
        # Six bounces, and the sky itself is no part of the photo: it stays transparent.
        "integrator": {"type": "path", "max_depth": 6, "hide_emitters": True},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.52, 0.56, 0.64]}},
        "window": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=[2.6, -1.8, 4.2], target=[0, 0, 0], up=[0, 0, 1]
            )
            @ mi.ScalarTransform4f().scale([1.1, 1.1, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [13.0, 11.8, 9.8]}},
        },
    }
    scene.update({f"shape_{index}": item for index, item in enumerate(shapes)})
    return mi.load_dict(scene)


# ---- writing ----------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "tea_table")
    parser.add_argument("--samples", type=int, default=121, help="light paths per pixel, a square")
    parser.add_argument("--only", type=int, help="take only the first so many photos of each split")
    arguments = parser.parse_args()

    splits = {"train": train_cameras(np.random.default_rng(SEED)), "test": test_cameras()}
    off = check_cameras(splits["train"][:2] + splits["test"][:1])
    print(f"cameras checked: lamps within {off:.3f} pixels of where they belong")

    jobs = []
    for split, cameras in splits.items():
        (arguments.out / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for index, matrix in enumerate(cameras[: arguments.only]):
            name = f"{split}/{index:03d}"
            jobs.append((name, matrix, len(jobs)))
            frames.append({"file_path": f"./{name}", "transform_matrix": matrix.tolist()})
        content = {"camera_angle_x": FIELD_OF_VIEW, "frames": frames}
        path = arguments.out / f"transforms_{split}.json"
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    scene = build_scene()
    for name, matrix, seed in jobs:
        photo = encode(take_photo(scene, matrix, arguments.samples, seed))
        Image.fromarray(photo).save(arguments.out / f"{name}.png", optimize=True)
        print(arguments.out / f"{name}.png", flush=True)


if __name__ == "__main__":
    main()
