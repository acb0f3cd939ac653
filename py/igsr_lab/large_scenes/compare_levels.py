"""Levels of detail of a scene, and of a city made of copies of it.

How near levels are to the whole, and what a budget draws and holds:

    python -m igsr_lab.large_scenes.compare_levels SCENE CAPTURE --out DIR [--copies 8]

Each level is compared with the scene in pictures of the capture's cameras, from as near as they
are and from 2 to 16 times as far: smaller pictures, whose truth is the mean of the whole scene's
pixels. The city leaves out sky and haze, which would be there once for each copy.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import igsr
from igsr.capture import Camera, View, load_capture
from igsr.capture.write_transforms import write_cameras
from igsr.evaluation.metrics import psnr, ssim
from igsr.rendering.levels import INDEX, level_within, write_levels

#: How many times as far.
FAR = (1, 2, 4, 8, 16)
#: Splats whose standard deviations are beyond this part of the scene are sky and haze of one copy.
HAZE = 0.1
NAMES = ("means", "quats", "scales", "opacities", "sh")


def smaller(camera: Camera, times: int) -> Camera:
    """A camera whose picture is so many times smaller."""
    K = camera.K.copy()
    K[:2] /= times
    return Camera(camera.viewmat, K, camera.width // times, camera.height // times)


def mean_of(image: np.ndarray, times: int) -> np.ndarray:
    """Means of squares of so many pixels a side."""
    height, width = (side // times for side in image.shape[:2])
    image = image[: height * times, : width * times]
    return image.reshape(height, times, width, times, 3).mean(axis=(1, 3))


def drawn(splats: igsr.Splats, camera: Camera) -> np.ndarray:
    """A picture, clipped to what a screen shows."""
    return np.clip(igsr.render(splats, camera, backend="cpu").color, 0.0, 1.0)


def in_bytes(image: np.ndarray) -> np.ndarray:
    """A picture of uint8."""
    return np.rint(255.0 * image).astype(np.uint8)


def scores(splats: igsr.Splats, cameras: list[Camera], true: list[np.ndarray]) -> list[str]:
    """PSNR in dB and SSIM of each distance."""
    rows = []
    for times in FAR:
        decibels, alike = [], []
        for camera, whole in zip(cameras, true, strict=True):
            seen = in_bytes(drawn(splats, smaller(camera, times)))
            wanted = in_bytes(mean_of(whole, times))
            decibels.append(psnr(seen, wanted))
            alike.append(ssim(seen, wanted))
        rows.append(f"{np.mean(decibels):.1f} / {np.mean(alike):.3f}")
    return rows


def city(scene: igsr.Splats, copies: int) -> igsr.Splats:
    """Copies of a scene side by side on the plane that it spreads along."""
    middle = np.median(scene.means, axis=0)
    side = np.quantile(np.abs(scene.means - middle), 0.95, axis=0)
    along = np.argsort(side)[1:]
    inside = (np.abs(scene.means - middle) < 1.1 * side).all(axis=1)
    keep = inside & (np.exp(scene.scales).max(axis=1) < HAZE * side.max())
    kept = replace(scene, **{name: getattr(scene, name)[keep] for name in NAMES})
    shifts = np.zeros((copies * copies, 3), np.float32)
    grid = np.stack(np.meshgrid(*[np.arange(copies) - copies // 2] * 2), axis=-1).reshape(-1, 2)
    shifts[:, along] = 2.0 * grid * side[along]
    means = (kept.means + shifts[:, None, :]).reshape(-1, 3).astype(np.float32)
    copied = {name: np.concatenate([getattr(kept, name)] * len(shifts)) for name in NAMES}
    return replace(kept, **{**copied, "means": means})


def over(large: igsr.Splats) -> list[View]:
    """Two cameras: over the streets of a city, looking across it, and above all of it."""
    low, high = np.quantile(large.means, [0.02, 0.98], axis=0)
    side = high - low
    along = np.argsort(side)[1:]
    # The wider side lies across the picture.
    ahead = np.eye(3)[along[0]]
    up = np.array([0.0, -1.0, 0.0])
    middle = 0.5 * (low + high)
    corner = low + 0.1 * side
    corner[1] = middle[1]
    across = low + 0.45 * side
    across[1] = middle[1]
    far = 0.7 * side.max()
    return [
        looking(corner + 0.03 * side.max() * up, across, "street"),
        looking(middle + far * (up - 0.6 * ahead), middle, "above"),
    ]


def looking(eye: np.ndarray, at: np.ndarray, name: str) -> View:
    """A view of 960 x 600 pixels from one place to another; y is down."""
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    K = np.array([[700.0, 0, 480], [0, 700.0, 300], [0, 0, 1]])
    blank = np.zeros((600, 960, 3), np.uint8)
    return View(f"{name}.png", Camera(viewmat, K, 960, 600), "train", blank)


def timed(words: list[str]) -> tuple[str, float, int]:
    """What a command says, its seconds, and the most kB that it held."""
    code = (
        "import resource, subprocess, sys; done = subprocess.run(sys.argv[1:]); "
        "print('kB', resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr); "
        "sys.exit(done.returncode)"
    )
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    seconds = time.perf_counter() - start
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    said, _, kilobytes = done.stderr.rpartition("kB ")
    return said.strip(), seconds, int(kilobytes)


def main() -> None:
    """Write levels, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--copies", type=int, default=8)
    parser.add_argument("--budgets", default="50000,200000")
    parser.add_argument("--max-size", type=int, default=800)
    parser.add_argument("--per-cell", type=int, default=4096)
    args = parser.parse_args()
    args.out.mkdir(parents=True)
    scene = igsr.Splats.load(args.scene)
    views = load_capture(args.capture, max_size=args.max_size).views
    views = [views[i] for i in np.linspace(0, len(views) - 1, 4).astype(int)]
    cameras = [view.camera for view in views]
    true = [drawn(scene, camera) for camera in cameras]

    print(f"| of {args.scene} | splats | " + " | ".join(f"{times}x" for times in FAR) + " |")
    print(f"| whole | {len(scene)} | " + " | ".join(scores(scene, cameras, true)) + " |")
    written = write_levels(args.scene, args.out / "levels", 4, args.per_cell)
    for level, count in enumerate(written.counts):
        found = level_within(args.out / "levels" / INDEX, count)
        row = " | ".join(scores(found, cameras, true))
        print(f"| {level} | {count} | {row} |", flush=True)

    if args.copies == 0:
        return
    large = city(scene, args.copies)
    path, folder = args.out / "city.ply", args.out / "city"
    large.save(path)
    write_cameras(args.out / "cameras.json", over(large))
    convert = [sys.executable, "-m", "igsr.cli", "convert", str(path), str(folder), "--lod", "5"]
    _, seconds, kilobytes = timed(convert)
    disk = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    sizes = f"{path.stat().st_size / 1e6:.0f} MB as .ply, {disk / 1e6:.0f} MB in levels"
    print(f"\n{len(large)} splats, {sizes}")
    print(f"convert --lod 5: {seconds:.0f} s, {kilobytes / 1024:.0f} MB")
    index = json.loads((folder / INDEX).read_text())
    print(f"levels {index['counts']}, {len(index['filenames'])} files")
    view = [sys.executable, "-m", "igsr.rendering.window"]
    shot = ["--backend", "cpu", "--screenshot"]
    for camera, place in enumerate(("street", "above")):
        seen_from = ["--cameras", str(args.out / "cameras.json"), "--camera", str(camera)]
        # The truth is the mean of 16 pixels for each: far splats are smaller than one.
        file = args.out / f"{place}-finer.png"
        timed([*view, str(path), *shot, str(file), *seen_from, "--size", "3840x2400"])
        wanted = in_bytes(mean_of(np.asarray(Image.open(file)) / 255.0, 4))
        budgets = [(folder, budget, ["--budget", budget]) for budget in args.budgets.split(",")]
        for shown, name, more in [(path, "whole", []), *budgets]:
            file = args.out / f"{place}-{name}.png"
            said, seconds, kilobytes = timed(
                [*view, str(shown), *shot, str(file), *seen_from, *more]
            )
            picture = np.asarray(Image.open(file))
            score = f"{psnr(picture, wanted):.1f} / {ssim(picture, wanted):.3f}"
            memory = f"{kilobytes / 1024:.0f} MB"
            print(f"{place} {name}: {score}, {seconds:.1f} s, {memory}. {said}", flush=True)


if __name__ == "__main__":
    main()
