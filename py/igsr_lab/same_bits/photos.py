"""Small synthetic captures for ``same_bits``, rendered by igsr."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import igsr


def made_up_splats(count: int, seed: int, degree: int = 1) -> igsr.Splats:
    """Colored splats in a ball of radius 1; many are flat, which gives corners to match."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sh = random.normal(scale=0.15, size=(count, (degree + 1) ** 2, 3))
    sh[:, 0] = random.uniform(-1.7, 1.7, size=(count, 3))
    return igsr.Splats(
        means=(directions * random.uniform(0.55, 1.0, size=(count, 1))).astype(np.float32),
        quats=random.normal(size=(count, 4)).astype(np.float32),
        scales=random.uniform(-3.6, -2.1, size=(count, 3)).astype(np.float32),
        opacities=random.uniform(0.5, 5.0, size=count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def with_wall(ball: igsr.Splats, seed: int) -> igsr.Splats:
    """Add a wall of colored splats behind the ball, so that photos need no alpha."""
    random = np.random.default_rng(seed)
    count = 700
    means = random.uniform(-3.2, 3.2, size=(count, 3))
    means[:, 2] = 1.6 + 0.1 * random.normal(size=count)
    sh = np.zeros((count, ball.sh.shape[1], 3))
    sh[:, 0] = random.uniform(-1.7, 1.7, size=(count, 3))
    parts = {
        "means": means,
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "scales": random.uniform([-2.2, -2.2, -4.0], [-1.4, -1.4, -3.5], size=(count, 3)),
        "opacities": random.uniform(1.0, 5.0, size=count),
        "sh": sh,
    }
    joined = {
        name: np.concatenate([getattr(ball, name), part.astype(np.float32)])
        for name, part in parts.items()
    }
    return igsr.Splats(**joined)


def camera_at(
    right: float, up: float, width: int, height: int, distance: float = 4.0
) -> igsr.Camera:
    """Return a camera that looks at the origin from two angles in degrees."""
    a, b = math.radians(right), math.radians(up)
    back = np.array([math.sin(a) * math.cos(b), -math.sin(b), -math.cos(a) * math.cos(b)])
    z = -back
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, np.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ (distance * back)
    focal = 1.5 * width
    K = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
    return igsr.Camera(viewmat, K, width, height)


def moved(camera: igsr.Camera, random: np.random.Generator, by: float) -> igsr.Camera:
    """Turn a camera by about ``by`` radians and move it by about ``2 * by`` units."""
    turn = random.normal(scale=by, size=3)
    angle = float(np.linalg.norm(turn))
    x, y, z = turn / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    change = np.eye(4)
    change[:3, :3] += math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    change[:3, 3] = random.normal(scale=2.0 * by, size=3)
    return replace(camera, viewmat=change @ camera.viewmat)


def picture_of(splats: igsr.Splats, camera: igsr.Camera, alpha: bool) -> np.ndarray:
    """Render a uint8 photo, with straight alpha or on black."""
    rendered = igsr.render(splats, camera, backend="reference")
    if not alpha:
        return rendered.to_uint8()
    coverage = np.clip(rendered.alpha, 1e-6, 1.0)
    straight = np.clip(rendered.color / coverage[..., None], 0.0, 1.0)
    rgba = np.concatenate([straight, rendered.alpha[..., None]], axis=-1)
    return np.floor(rgba * 255.0 + 0.5).astype(np.uint8)


def opengl_pose(camera: igsr.Camera) -> list[list[float]]:
    """Camera-to-world matrix in OpenGL axes, as in NeRF-Synthetic's files."""
    return (np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def write_ball(folder: Path, splats: igsr.Splats) -> Path:
    """Write a capture in NeRF-Synthetic's layout: 9 photos to fit and 3 to test, with alpha."""
    width, height = 64, 56
    for split, angles in (("train", range(0, 360, 40)), ("test", (20, 140, 260))):
        frames = []
        for number, angle in enumerate(angles):
            camera = camera_at(angle, 12.0 * (number % 3 - 1), width, height)
            path = folder / split / f"r_{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture_of(splats, camera, alpha=True)).save(path)
            frames.append(
                {"file_path": f"./{split}/r_{number}", "transform_matrix": opengl_pose(camera)}
            )
        field = 2.0 * math.atan(0.5 / 1.5)
        document = {"camera_angle_x": field, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder


def write_room(folder: Path, splats: igsr.Splats) -> Path:
    """Write photos and a COLMAP text model with inexact cameras, points and tracks."""
    width, height = 136, 128
    random = np.random.default_rng(5)
    angles = [(10.0 * (k % 4) - 15.0, 12.0 * (k // 4) - 6.0) for k in range(8)]
    cameras = [camera_at(right, up, width, height, distance=3.6) for right, up in angles]
    xyz = splats.means[::3].astype(np.float64)
    images, tracks, errors = [], [[] for _ in xyz], [[] for _ in xyz]
    for number, true in enumerate(cameras, 1):
        path = folder / "images" / f"p{number:02d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture_of(splats, true, alpha=False)).save(path)
        local = xyz @ true.viewmat[:3, :3].T + true.viewmat[:3, 3]
        noise = random.normal(scale=0.3, size=(len(xyz), 2))
        xy = (local @ true.K.T)[:, :2] / local[:, 2:] + noise
        inside = (xy > 0.0).all(axis=1) & (xy[:, 0] < width) & (xy[:, 1] < height)
        seen = np.flatnonzero(inside & (random.uniform(size=len(xyz)) > 0.2))
        for feature, point in enumerate(seen):
            tracks[point].append((number, feature))
            errors[point].append(float(np.linalg.norm(noise[point])))
        given = moved(true, random, 0.004)
        quat = quaternion(given.viewmat[:3, :3])
        pose = " ".join(map(repr, [*quat, *given.viewmat[:3, 3].tolist()]))
        images.append(f"{number} {pose} 1 {path.name}")
        images.append(" ".join(f"{xy[p, 0]:.4f} {xy[p, 1]:.4f} {p + 1}" for p in seen))
    points = []
    for point, (track, error) in enumerate(zip(tracks, errors, strict=True)):
        if len(track) < 2:
            continue
        place = " ".join(f"{value:.6f}" for value in xyz[point] + random.normal(scale=0.01, size=3))
        color = " ".join(str(value) for value in random.integers(0, 256, size=3))
        elements = " ".join(f"{image} {feature}" for image, feature in track)
        points.append(f"{point + 1} {place} {color} {np.mean(error):.4f} {elements}")
    kept = {line.split()[0] for line in points}
    for row in range(1, len(images), 2):
        words = images[row].split()
        for k in range(2, len(words), 3):
            words[k] = words[k] if words[k] in kept else "-1"
        images[row] = " ".join(words)
    focal = 1.5 * width * 1.02
    camera = f"1 PINHOLE {width} {height} {focal!r} {focal!r} {width / 2!r} {height / 2!r}"
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    for name, lines in (("cameras", [camera]), ("images", images), ("points3D", points)):
        (model / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


def quaternion(rotation: np.ndarray) -> list[float]:
    """Quaternion (w, x, y, z) of a rotation by less than 180 degrees."""
    w = 0.5 * math.sqrt(max(0.0, 1.0 + float(np.trace(rotation))))
    x, y, z = (
        (rotation[2, 1] - rotation[1, 2]) / (4.0 * w),
        (rotation[0, 2] - rotation[2, 0]) / (4.0 * w),
        (rotation[1, 0] - rotation[0, 1]) / (4.0 * w),
    )
    return [w, float(x), float(y), float(z)]


def write_bent(folder: Path, splats: igsr.Splats) -> Path:
    """Write photos with masks and lens distortion, which igsr removes when it loads them."""
    frames = []
    for number in range(4):
        camera = camera_at(25.0 * number, 5.0, 60, 48)
        for kind, picture in (
            ("images", picture_of(splats, camera, alpha=False)),
            ("masks", np.full((48, 60), 255, np.uint8)),
        ):
            if kind == "masks":
                picture[8:20, 10 + 5 * number : 30] = 0
            path = folder / kind / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture).save(path)
        frames.append(
            {
                "file_path": f"images/{number}.png",
                "mask_path": f"masks/{number}.png",
                "transform_matrix": opengl_pose(camera),
            }
        )
    lens = {"k1": -0.12, "k2": 0.03, "p1": 0.004, "p2": -0.006}
    camera = {"fl_x": 90.0, "fl_y": 91.0, "cx": 29.0, "cy": 25.0, "w": 60, "h": 48}
    document = {"camera_model": "OPENCV", **camera, **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def write_plain_photos(folder: Path) -> Path:
    """Write photos of a textured wall with steps in depth, without cameras."""
    folder.mkdir(parents=True)
    random = np.random.default_rng(11)
    size, depth = 420, 3.0
    coarse = Image.fromarray(random.integers(0, 256, (70, 70, 3), dtype=np.uint8))
    fine = random.integers(-40, 41, (size, size, 3))
    wall = np.asarray(coarse.resize((size, size), Image.Resampling.BICUBIC)).astype(int) + fine
    wall = np.clip(wall, 0, 255).astype(np.uint8)
    width, height, focal = 240, 200, 240.0
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for number in range(7):
        camera = camera_at(6.0 * number - 18.0, 4.0 * (number % 3) - 4.0, width, height, depth)
        rays = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], -1)
        rays = rays @ camera.viewmat[:3, :3]
        picture = np.zeros((height, width, 3), np.uint8)
        # The right half of the wall is farther away, and its middle nearer.
        for z, low, high in ((0.5, 0.0, 9.0), (0.0, -9.0, 0.0), (-0.4, -0.5, 0.6)):
            reach = (z - camera.center[2]) / rays[..., 2]
            place = camera.center[:2] + reach[..., None] * rays[..., :2]
            column, row = ((place + 1.75) / 3.5 * size).astype(int).transpose(2, 0, 1)
            inside = (place[..., 0] >= low) & (place[..., 0] < high)
            if z < 0.0:
                inside &= np.abs(place[..., 1]) < 0.6
            shown = wall[(row + int(90 * z)) % size, column % size]
            picture = np.where(inside[..., None], shown, picture)
        Image.fromarray(picture).save(folder / f"p{number}.png")
    return folder
