"""Renders the example capture: a small table laid for tea, photographed from all around.

    make example-capture

or, with igsr and ``examples/requirements.txt`` installed,

    python examples/make_capture.py --out examples/tea_table

Everything in the scene is made here: the meshes and textures with numpy, the light and the photos
with Mitsuba 3 (``scalar_rgb``, which needs no driver). The capture is in the NeRF-Synthetic layout:
``transforms_train.json`` and ``transforms_test.json`` (``camera_angle_x``, camera-to-world matrices
in OpenGL axes, ``file_path`` without ``.png``) with 8-bit sRGB PNGs with straight alpha.

The same seed gives the same files. Before any photo is taken, the cameras are checked: small lamps
at known places are rendered through them and must appear at the projections of the written
matrices.
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

from igsr_lab.synth.cameras import Viewpoint
from igsr_lab.synth.meshes import Mesh, box, grid_mesh, lathe, place, tube
from igsr_lab.synth.mitsuba_scene import bitmap, camera_error, encode, sensor, shape
from igsr_lab.synth.textures import mix, noise

mi.set_variant("scalar_rgb")

SIZE = 256
FIELD_OF_VIEW = math.radians(36.0)
DISTANCE = 4.3
TARGET = np.array([0.0, 0.0, 0.28])
TRAIN_VIEWS = 40
TEST_VIEWS = 8
SEED = 20

Scene = dict[str, Any]


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


def viewpoint(matrix: np.ndarray) -> Viewpoint:
    return Viewpoint(matrix, FIELD_OF_VIEW, SIZE, SIZE)


def take_photo(scene: mi.Scene, matrix: np.ndarray, samples: int, seed: int) -> np.ndarray:
    """Linear premultiplied RGBA float32 [H,W,4]."""
    sampler = {"type": "multijitter", "sample_count": samples, "seed": seed}
    camera = sensor(viewpoint(matrix), sampler)
    return np.array(mi.render(scene, sensor=camera, spp=samples, seed=seed))


def check_cameras(cameras: list[np.ndarray], tolerance: float = 0.05) -> float:
    """Renders lamps at known places; returns the largest error of their positions, pixels."""
    lamps = TARGET + np.array([[0.8, 0, 0], [0, 0.7, 0.2], [-0.6, -0.5, 0], [0.1, 0.2, 0.6]])
    worst = camera_error([viewpoint(matrix) for matrix in cameras], lamps, radius=0.03)
    if worst > tolerance:
        raise SystemExit(f"a lamp appears {worst:.2f} pixels from its projection")
    return worst


# ---- textures: sRGB in [0,1], float32 [H,W,3] -------------------------------------------------


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


# ---- the scene --------------------------------------------------------------------------------


def matte(color: Any) -> Scene:
    if isinstance(color, np.ndarray):
        return {"type": "diffuse", "reflectance": bitmap(color)}
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}}


def glossy(color: Any, roughness: float) -> Scene:
    reflectance = matte(color)["reflectance"]
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
        bsdf = mi.load_dict({"type": "twosided", "bsdf": material})
        shapes.append(shape(mesh, bsdf, smooth))

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

    # Two crossed books.
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
        # Six bounces; the sky stays transparent.
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
    parser.add_argument("--only", type=int, help="maximum number of photos of each split")
    arguments = parser.parse_args()

    splits = {"train": train_cameras(np.random.default_rng(SEED)), "test": test_cameras()}
    off = check_cameras(splits["train"][:2] + splits["test"][:1])
    print(f"cameras checked: lamps within {off:.3f} pixels of their projections")

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
