"""Make pictures of README and the guides from the example capture.

    python docs/_site/pictures.py                       # all, in about 16 minutes on two cores
    python docs/_site/pictures.py floaters exposure     # these

Needs a Chromium browser, and Xvfb and xdotool for the picture of the window.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont, ImageGrab

import igsr
from igsr.blocks.cells import grid_of
from igsr.capture import View
from igsr.denoiser import photo_sources, photo_support, render_buffers
from igsr.geometry.camera_paths import orbit

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "tea_table"
PROGRAMS = Path(sys.executable).parent
WHITE = (1.0, 1.0, 1.0)
MAX_SPLATS = 20_000
DISPLAY = ":97"
OUTPUT = tempfile.TemporaryDirectory()
#: Colors of blocks.
TINTS = np.array([[214, 69, 65], [66, 133, 208], [80, 165, 90], [226, 160, 48]]) / 255

sys.path.insert(0, str(ROOT / "tests"))
import apps  # noqa: E402
from browser import Browser  # noqa: E402

CAPTURE = igsr.load_capture(EXAMPLE)
TRAIN, TEST = CAPTURE.train_views, CAPTURE.test_views
PICTURES: dict[str, Callable[[Path], None]] = {}


def picture(function: Callable[[Path], None]) -> Callable[[Path], None]:
    PICTURES[function.__name__] = function
    return function


def save(name: str, image: Image.Image, width: int = 768) -> None:
    """Save docs/images/NAME.jpg, ``width`` pixels wide."""
    path = ROOT / "docs" / "images" / f"{name}.jpg"
    image = image.convert("RGB").resize((width, width * image.height // image.width))
    image.save(path, quality=80, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def strip(images: Sequence[np.ndarray], titles: Sequence[str] = ()) -> Image.Image:
    """8-bit images of one height, from left to right, with titles above."""
    row = Image.fromarray(np.concatenate(images, axis=1))
    if not titles:
        return row
    page = Image.new("RGB", (row.width, row.height + 24), "white")
    page.paste(row, (0, 24))
    draw, font, left = ImageDraw.Draw(page), ImageFont.load_default(14), 0
    for image, title in zip(images, titles, strict=True):
        draw.text((left + 8, 5), title, "black", font)
        left += image.shape[1]
    return page


def run(*words: object) -> None:
    subprocess.run([PROGRAMS / "igsr", *map(str, words)], check=True)


def fit(views: Sequence[View], **options) -> igsr.Splats:
    capture = replace(CAPTURE, views=[*views, *TEST])
    return igsr.fit(capture, **{"max_splats": MAX_SPLATS, **options}).splats


def render(splats: igsr.Splats, view: View) -> np.ndarray:
    return igsr.render(splats, view.camera, WHITE).to_uint8()


def photo(view: View) -> np.ndarray:
    """The photo over white, uint8 [H, W, 3]."""
    image = Image.fromarray(view.image)
    over = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return np.asarray(over.convert("RGB"))


def depth_colors(depth: np.ndarray) -> np.ndarray:
    """Depth in gray: near is dark, unknown is white."""
    known = np.isfinite(depth) & (depth > 0)
    low, high = np.percentile(depth[known], (1, 99))
    gray = 30 + 190 * np.clip((depth - low) / (high - low), 0, 1)
    return np.repeat(np.where(known, gray, 255).astype(np.uint8)[..., None], 3, axis=2)


@functools.cache
def four() -> igsr.Splats:
    return fit(TRAIN[::10])


@functools.cache
def forty() -> igsr.Splats:
    return fit(TRAIN)


@functools.cache
def example(command: str) -> Path:
    """The output folder of the command for the example."""
    folder = Path(OUTPUT.name) / command
    run(command, "--example", "--out", folder)
    return folder


@picture
def tea_table(folder: Path) -> None:
    """An animated turn of the demo's scene, for README."""
    splats = igsr.Splats.load(example("refine") / "scene.ply")
    path = orbit(splats, [view.camera for view in TRAIN], 40)
    frames = [igsr.render(splats, doubled(camera), WHITE).to_uint8() for camera in path]
    seen = np.stack(frames).min(axis=(0, 3)) < 250
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    box = (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
    images = [Image.fromarray(frame).crop(box) for frame in frames]
    file = ROOT / "docs" / "images" / "tea_table.webp"
    options = {"duration": 100, "loop": 0, "quality": 50, "method": 6}
    images[0].save(file, save_all=True, append_images=images[1:], **options)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


def doubled(camera: igsr.Camera) -> igsr.Camera:
    """The camera with twice the pixels per side."""
    K = np.diag([2.0, 2.0, 1.0]) @ camera.K
    return replace(camera, K=K, width=2 * camera.width, height=2 * camera.height)


@picture
def poses(folder: Path) -> None:
    run("pose", EXAMPLE / "train", "--matcher", "sift", "--out", folder, "--plot")
    with Image.open(folder / "poses.png") as plot:
        save("poses", plot, width=1000)


@picture
def report(folder: Path) -> None:
    with Browser(folder / "profile", size=(900, 1420)) as browser:
        browser.load(example("fit") / "report.html")
        browser.run("frames[0].igsr.ready.then(() => true)")
        browser.run("new Promise((resolve) => setTimeout(resolve, 3000))")  # the first frame
        browser.screenshot(folder / "report.png")
    with Image.open(folder / "report.png") as page:
        save("report", page, width=600)


@picture
def app(folder: Path) -> None:
    shots = []
    with (
        apps.served(str(folder / "scenes")) as address,
        apps.Page(folder / "profile", (700, 960)) as page,
    ):
        page.open_app(address)
        page.drop(sorted((EXAMPLE / "train").glob("*.png"))[:8])
        page.wait_for_text("8 photos can be used.")
        page.wait_for("document.querySelectorAll('.grid-container img').length == 8")
        time.sleep(1)
        page.screenshot(folder / "start.png")
        page.press("Use the example photos")
        page.opened_run()
        page.wait_for_text("Renders of held-out photos", timeout=600.0)
        page.wait_for("document.querySelectorAll('.scene img').length >= 4")
        time.sleep(5)  # the first frames
        page.screenshot(folder / "done.png")
        for name in ("start", "done"):
            with Image.open(folder / f"{name}.png") as shot:
                shots.append(np.asarray(shot.convert("RGB")))
    save("app", strip(shots), width=1000)


@picture
def window(folder: Path) -> None:
    display = {**os.environ, "DISPLAY": DISPLAY}
    find = ["xdotool", "search", "--onlyvisible", "--name", "splat-view"]
    words = [PROGRAMS / "splat-view", example("fit"), "--camera", "3", "--size", "1280x800"]
    with subprocess.Popen(["Xvfb", DISPLAY, "-screen", "0", "1280x800x24"]) as server:
        time.sleep(2)  # it starts
        with subprocess.Popen(words, env=display) as viewer:
            while subprocess.run(find, env=display, stdout=subprocess.DEVNULL).returncode:
                time.sleep(1)
            time.sleep(20)  # the first frames
            shot = ImageGrab.grab(xdisplay=DISPLAY)
            viewer.kill()
        server.terminate()
    save("window", shot, width=900)


@picture
def few_photos(folder: Path) -> None:
    eight = igsr.Splats.load(example("fit") / "scene.ply")
    save("few_photos", strip([render(splats, TEST[0]) for splats in (four(), eight, forty())]))


@picture
def denoised(folder: Path) -> None:
    few = TRAIN[::10]
    support = photo_support(four(), few)
    buffers = render_buffers(four(), TEST[0].camera, support, WHITE)
    cleaned, confidence = igsr.denoise(buffers, photo_sources(four(), few, WHITE))
    arrays = (cleaned, np.stack(3 * [confidence], -1))
    images = [np.rint(255 * array).astype(np.uint8) for array in arrays]
    save("denoised", strip([render(four(), TEST[0]), *images]))


@picture
def floaters(folder: Path) -> None:
    few = TRAIN[::5]
    options = {"start": "random", "density": "original", "dropout": 0.0}
    before = fit(few, remove_floaters=False, **options)
    after = igsr.remove_floaters(before, replace(CAPTURE, views=few)).splats
    images = [render(before, TEST[1]), render(after, TEST[1]), photo(TEST[1])]
    save("floaters", strip(images, ["with floaters", "floaters removed", "photo"]))


@picture
def depths(folder: Path) -> None:
    few = [
        replace(view, depth=igsr.render(forty(), view.camera).expected_depth)
        for view in TRAIN[::10]
    ]
    images = [depth_colors(few[0].depth), render(four(), TEST[2]), render(fit(few), TEST[2])]
    save("depths", strip(images, ["one depth map", "without depth maps", "with depth maps"]))


def unequal_exposures(spread: float) -> list[View]:
    """Every fourth photo, with random log gains within ``spread`` and different white balance."""
    rng = np.random.default_rng(0)
    count = len(TRAIN[::4])
    brightness = np.exp(rng.uniform(-spread, spread, (count, 1)))
    views = []
    for view, gain in zip(
        TRAIN[::4], brightness * np.exp(rng.normal(0, 0.08, (count, 3))), strict=True
    ):
        image = view.image.copy()
        image[..., :3] = np.clip(np.rint(image[..., :3] * gain), 0, 255)
        views.append(replace(view, image=image))
    return views


@picture
def exposure(folder: Path) -> None:
    views = unequal_exposures(0.5)
    scenes = [fit(views, exposure=mode) for mode in ("off", "on")]
    images = [photo(views[3]), photo(views[5]), *(render(splats, TEST[4]) for splats in scenes)]
    titles = ["a dark photo", "a bright photo", "--exposure off", "--exposure on"]
    save("exposure", strip(images, titles), width=1024)


@picture
def transients(folder: Path) -> None:
    """A person stands in front of the table in one photo."""
    views = list(TRAIN[::4])
    person = Image.new("RGBA", (1024, 1024))
    draw = ImageDraw.Draw(person)
    draw.ellipse((600, 240, 728, 384), fill=(225, 180, 150))
    draw.rounded_rectangle((544, 376, 784, 1080), radius=88, fill=(60, 120, 70))
    shown = Image.fromarray(views[3].image)
    shown.alpha_composite(person.resize(shown.size, Image.Resampling.BOX))
    views[3] = replace(views[3], image=np.asarray(shown))
    scenes = [fit(views, transients=mode) for mode in ("off", "on")]
    images = [photo(views[3]), *(render(splats, TEST[4]) for splats in scenes)]
    save("transients", strip(images, ["photo", "--transients off", "--transients on"]))


@picture
def blocks(folder: Path) -> None:
    """The scene from above, in the colors of the cells, with the cameras."""
    cameras = [view.camera for view in TRAIN]
    grid = grid_of(cameras, len(TINTS))
    splats = forty()
    up = np.cross(*grid.axes)
    up *= np.sign(np.mean([camera.center @ up for camera in cameras]))
    across = grid.axes[0]
    rotation = np.stack([across, np.cross(-up, across), -up])
    size, height = 480, 22.0
    focal = 0.5 * size * height / (1.15 * max(np.linalg.norm(c.center) for c in cameras))
    viewmat, K = np.eye(4), np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (height * up)
    above = igsr.Camera(viewmat, K, size, size)

    sh = splats.sh.copy()
    tint = TINTS[grid.inside(grid.splat_positions(splats)).argmax(axis=1)]
    sh[:, 0] = 0.55 * sh[:, 0] + 0.45 * (tint - 0.5) / 0.2820948
    image = Image.fromarray(igsr.render(replace(splats, sh=sh), above, WHITE).to_uint8())
    draw = ImageDraw.Draw(image)
    for camera in cameras:
        x, y, z = rotation @ (camera.center - height * up)
        x, y = focal * x / z + size / 2, focal * y / z + size / 2
        cell = grid.inside(grid.positions(camera.center[None])).argmax()
        color = tuple(np.rint(255 * TINTS[cell]).astype(int))
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=color, outline="black")
    save("blocks", image, width=size)


@picture
def smaller_scenes(folder: Path) -> None:
    forty().save(folder / "scene.ply")
    loss = ("--max-loss", "0.5dB", "--steps", "1000")
    words = ("--capture", EXAMPLE, "--out", folder / "small.ply")
    run("compact", folder / "scene.ply", *loss, *words)
    with Image.open(folder / "small.png") as plot:
        save("smaller_scenes", plot)


@picture
def gsplat(folder: Path) -> None:
    """Outputs of one call of ``igsr.rasterization``."""
    camera = TEST[4].camera
    viewmats, Ks = (torch.tensor(m, dtype=torch.float32)[None] for m in (camera.viewmat, camera.K))
    arguments = forty().to_torch()
    renders, alphas, meta = igsr.rasterization(
        **arguments,
        viewmats=viewmats,
        Ks=Ks,
        width=camera.width,
        height=camera.height,
        backgrounds=torch.ones(1, 3),
        render_mode="RGB+ED",
        render_normals=True,
    )
    color, depth, alpha = renders[0, ..., :3], renders[0, ..., 3], alphas[0]
    images = [
        np.rint(255 * color.clamp(0, 1).numpy()).astype(np.uint8),
        depth_colors(np.where(alpha[..., 0] > 0.5, depth, 0)),
        np.rint(127.5 + 127.5 * meta["render_normals"][0].clamp(-1, 1).numpy()).astype(np.uint8),
    ]
    save("gsplat", strip(images, ["RGB", "expected depth", "normals"]))


@picture
def troubleshooting(folder: Path) -> None:
    """How faults look: each of them made on purpose."""
    side = TEST[4].camera.center[:2]

    def faces(view: View) -> float:
        center = view.camera.center[:2]
        return float(center @ side / np.linalg.norm(center))

    one_side = fit(sorted(TRAIN, key=faces)[-12:])
    rng = np.random.default_rng(0)
    turned = [replace(view, camera=off(view.camera, rng)) for view in TRAIN[::2]]
    images = [
        render(one_side, TEST[1]),
        render(fit(unequal_exposures(1.2)), TEST[4]),
        render(fit(turned), TEST[4]),
        render(fit(TRAIN[::2], steps=60), TEST[4]),
    ]
    titles = ["photos of one side", "different exposures", "wrong cameras", "too few steps"]
    save("troubleshooting", strip(images, titles), width=1024)


def off(camera: igsr.Camera, rng: np.random.Generator, degrees: float = 1.5) -> igsr.Camera:
    """The camera turned about a random axis."""
    x, y, z = axis = rng.normal(size=3)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / np.linalg.norm(axis)
    angle = np.deg2rad(degrees)
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    viewmat = camera.viewmat.copy()
    viewmat[:3] = rotation @ viewmat[:3]
    return replace(camera, viewmat=viewmat)


def main() -> None:
    for name in sys.argv[1:] or PICTURES:
        with tempfile.TemporaryDirectory() as folder:
            PICTURES[name](Path(folder))


if __name__ == "__main__":
    main()
