"""Quality and cost of the levels of detail of a scene, and of a city of copies of it.

    python -m igsr_lab.large_scenes.compare_levels SCENE CAPTURE --out DIR [--copies 8]

Each level is compared with the scene in the capture's views, at their distance and 2 to 16 times as
far: smaller pictures, whose truth is the mean of the whole scene's pixels. The city has no sky and
haze, which would be repeated with each copy.
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
from igsr_lab.large_scenes.towns import camera_at

#: Factors on the distance.
DISTANCES = (1, 2, 4, 8, 16)
#: Splats with a standard deviation above this fraction of the scene are sky and haze.
HAZE_FRACTION = 0.1
NAMES = ("means", "quats", "scales", "opacities", "sh")


def smaller(camera: Camera, times: int) -> Camera:
    """A camera with a smaller picture."""
    K = camera.K.copy()
    K[:2] /= times
    return Camera(camera.viewmat, K, camera.width // times, camera.height // times)


def mean_of(image: np.ndarray, times: int) -> np.ndarray:
    """Means of squares of pixels."""
    height, width = (side // times for side in image.shape[:2])
    image = image[: height * times, : width * times]
    return image.reshape(height, times, width, times, 3).mean(axis=(1, 3))


def rendered(splats: igsr.Splats, camera: Camera) -> np.ndarray:
    """A render, clipped to [0, 1]."""
    return np.clip(igsr.render(splats, camera, backend="cpu").color, 0.0, 1.0)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """A picture in [0, 1] as uint8."""
    return np.rint(255.0 * image).astype(np.uint8)


def scores(splats: igsr.Splats, cameras: list[Camera], true: list[np.ndarray]) -> str:
    """PSNR in dB and SSIM at each distance, as cells of a table."""
    cells = []
    for times in DISTANCES:
        pairs = [
            (to_uint8(rendered(splats, smaller(camera, times))), to_uint8(mean_of(whole, times)))
            for camera, whole in zip(cameras, true, strict=True)
        ]
        decibels, similarity = (np.mean([score(*pair) for pair in pairs]) for score in (psnr, ssim))
        cells.append(f"{decibels:.1f} / {similarity:.3f}")
    return " | ".join(cells)


def city(scene: igsr.Splats, copies: int) -> igsr.Splats:
    """Copies of a scene in a square grid on its ground plane."""
    middle = np.median(scene.means, axis=0)
    side = np.quantile(np.abs(scene.means - middle), 0.95, axis=0)
    along = np.argsort(side)[1:]
    inside = (np.abs(scene.means - middle) < 1.1 * side).all(axis=1)
    keep = inside & (np.exp(scene.scales).max(axis=1) < HAZE_FRACTION * side.max())
    kept = replace(scene, **{name: getattr(scene, name)[keep] for name in NAMES})
    shifts = np.zeros((copies * copies, 3), np.float32)
    grid = np.stack(np.meshgrid(*[np.arange(copies) - copies // 2] * 2), axis=-1).reshape(-1, 2)
    shifts[:, along] = 2.0 * grid * side[along]
    means = (kept.means + shifts[:, None, :]).reshape(-1, 3).astype(np.float32)
    copied = {name: np.concatenate([getattr(kept, name)] * len(shifts)) for name in NAMES}
    return replace(kept, **{**copied, "means": means})


def city_views(large: igsr.Splats) -> list[View]:
    """Two views: over the streets of a city, and from above all of it."""
    low, high = np.quantile(large.means, [0.02, 0.98], axis=0)
    side = high - low
    ahead = np.eye(3)[np.argsort(side)[1]]  # the wider side is across the picture
    up = np.array([0.0, -1.0, 0.0])
    middle = 0.5 * (low + high)
    corner, across = low + 0.1 * side, low + 0.45 * side
    corner[1] = across[1] = middle[1]
    eyes = {
        "street": (corner + 0.03 * side.max() * up, across),
        "above": (middle + 0.7 * side.max() * (up - 0.6 * ahead), middle),
    }
    blank = np.zeros((600, 960, 3), np.uint8)
    return [
        View(f"{name}.png", camera_at(eye, target, 700.0, 960, 600), "train", blank)
        for name, (eye, target) in eyes.items()
    ]


def timed(words: list[str]) -> tuple[str, float, int]:
    """Run a command; return its output, seconds, and peak memory in kB."""
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
    output, _, kilobytes = done.stderr.rpartition("kB ")
    return output.strip(), seconds, int(kilobytes)


def main() -> None:
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
    cameras = [views[i].camera for i in np.linspace(0, len(views) - 1, 4).astype(int)]
    true = [rendered(scene, camera) for camera in cameras]

    print(f"| of {args.scene} | splats | " + " | ".join(f"{times}x" for times in DISTANCES) + " |")
    print(f"| whole | {len(scene)} | {scores(scene, cameras, true)} |")
    written = write_levels(args.scene, args.out / "levels", 4, args.per_cell)
    for level, count in enumerate(written.counts):
        found = level_within(args.out / "levels" / INDEX, count)
        print(f"| {level} | {count} | {scores(found, cameras, true)} |", flush=True)
    if args.copies:
        compare_city(scene, args)


def compare_city(scene: igsr.Splats, args: argparse.Namespace) -> None:
    """Write a city in levels; print quality, time and memory of its budgets."""
    large = city(scene, args.copies)
    path, folder = args.out / "city.ply", args.out / "city"
    large.save(path)
    write_cameras(args.out / "cameras.json", city_views(large))
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
        # The truth is the mean of 16 pixels for each: distant splats are smaller than one.
        file = args.out / f"{place}-finer.png"
        timed([*view, str(path), *shot, str(file), *seen_from, "--size", "3840x2400"])
        wanted = to_uint8(mean_of(np.asarray(Image.open(file)) / 255.0, 4))
        budgets = [(folder, budget, ["--budget", budget]) for budget in args.budgets.split(",")]
        for shown, name, more in [(path, "whole", []), *budgets]:
            file = args.out / f"{place}-{name}.png"
            words = [*view, str(shown), *shot, str(file), *seen_from, *more]
            output, seconds, kilobytes = timed(words)
            picture = np.asarray(Image.open(file))
            score = f"{psnr(picture, wanted):.1f} / {ssim(picture, wanted):.3f}"
            memory = f"{kilobytes / 1024:.0f} MB"
            print(f"{place} {name}: {score}, {seconds:.1f} s, {memory}. {output}", flush=True)


if __name__ == "__main__":
    main()
